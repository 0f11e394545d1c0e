"""Samples along rays: each sampling gives the path integral on the mean, the adaptive one with the least scatter."""

from __future__ import annotations

import pytest
import torch

from nerif.fields.network import Network, NetworkShape, NeuralField
from nerif.geometry import Box, Rays
from nerif.reconstruction.neural.sampling import BINS, EVEN, SamplingDensity, sample_count, sample_rays

BOX = Box((-10.0, -10.0, -10.0), (10.0, 10.0, 10.0))


def rays(n: int = 400) -> Rays:
    """Through the box along x, at all heights and depths."""
    g = torch.Generator().manual_seed(0)
    origin = torch.cat([torch.full((n, 1), -100.0), 16 * torch.rand(n, 2, generator=g) - 8], dim=1)
    direction = torch.tensor([[1.0, 0.0, 0.0]]).expand(n, 3)
    none = torch.zeros(n)
    view = torch.zeros(n, dtype=torch.int16)
    return Rays(origin, direction, none, none, torch.zeros(n, 2), view, none).clip(BOX)


class Peak:
    """A field that varies in a thin layer at x = 3 mm only; in the coordinates of a network, 1 for 10 mm."""

    def value(self, p):
        return torch.tanh((p[:, 0] - 0.3) / 0.1)

    def value_and_gradient(self, p, heads):
        slope = (1 - self.value(p).square()) / 0.1
        return self.value(p), torch.stack([slope, 0 * slope, 0 * slope], dim=1), None


@pytest.fixture
def density() -> SamplingDensity:
    density = SamplingDensity(NeuralField(Network(NetworkShape(depth=1, width=4, octaves=0)), BOX, 1e-4))
    density.update(Peak())
    return density


def integral(sampling: str, seed: int, density: SamplingDensity | None = None, count: int = 12) -> torch.Tensor:
    """Of the layer's slope along each ray; 2 by the closed form."""
    r = rays()
    s, interval = sample_rays(r, count, torch.Generator().manual_seed(seed), sampling, density)
    assert bool(((s > r.near[:, None] - 1e-4) & (s < r.far[:, None] + 1e-4)).all())
    slope = Peak().value_and_gradient(r.at(s).reshape(-1, 3) / 10, False)[1][:, 0].reshape(s.shape)
    return (slope * interval / 10).sum(1)


def test_every_random_sampling_is_right_on_the_mean(density):
    for sampling in ("random", "shifted", "adaptive"):
        found = torch.stack([integral(sampling, seed, density) for seed in range(20)])
        error = float(found.std()) / found.numel() ** 0.5
        assert float(found.mean()) == pytest.approx(2.0, abs=max(4 * error, 1e-3)), sampling


def test_adaptive_samples_scatter_least(density):
    scatter = {s: float(integral(s, 1, density).std()) for s in ("random", "shifted", "adaptive")}
    assert scatter["adaptive"] < 0.3 * min(scatter["shifted"], scatter["random"])


def test_the_density_follows_the_layer_and_keeps_some_samples_everywhere(density):
    local = density.along(rays())
    assert local.shape == (400, BINS)
    torch.testing.assert_close(local.mean(1), torch.ones(400))
    assert float(local.min()) >= EVEN * 0.99
    x = -10 + 20 * (torch.arange(BINS) + 0.5) / BINS
    assert abs(float(x[local[0].argmax()]) - 3) < 1.5


def test_intervals_fill_the_ray(density):
    r = rays(50)
    s, interval = sample_rays(r, 30, torch.Generator().manual_seed(0), "regular")
    torch.testing.assert_close(interval.sum(1), r.far - r.near)
    torch.testing.assert_close(s[:, 0] - r.near, interval[:, 0] / 2, rtol=0, atol=1e-4)
    # adaptive intervals do so on the mean over the shift
    total = torch.stack(
        [sample_rays(r, 30, torch.Generator().manual_seed(k), "adaptive", density)[1].sum(1) for k in range(200)]
    ).mean(0)
    torch.testing.assert_close(total, r.far - r.near, rtol=0.02, atol=0)


def test_a_density_that_knows_nothing_changes_nothing():
    blank = SamplingDensity(NeuralField(Network(NetworkShape(depth=1, width=4, octaves=0)), BOX, 1e-4))
    a = sample_rays(rays(), 12, torch.Generator().manual_seed(2), "adaptive", blank)
    b = sample_rays(rays(), 12, torch.Generator().manual_seed(2), "shifted")
    assert all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def test_a_field_of_nothing_is_sampled_evenly():
    class Nothing(Peak):
        def value_and_gradient(self, p, heads):
            return p[:, 0] * 0, p * 0, None

    density = SamplingDensity(NeuralField(Network(NetworkShape(depth=1, width=4, octaves=0)), BOX, 1e-4))
    density.update(Nothing())
    torch.testing.assert_close(density.along(rays()), torch.ones(400, BINS))


def test_counts_grow_and_stay_within_the_jitter():
    g = torch.Generator().manual_seed(0)
    start = {sample_count(0.0, 12, 24, 4, g) for _ in range(300)}
    end = {sample_count(1.0, 12, 24, 4, g) for _ in range(300)}
    assert start == set(range(8, 17))
    assert end == set(range(20, 29))
