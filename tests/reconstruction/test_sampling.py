"""The random order of rays, and samples along them: unbiased, the adaptive ones with the least scatter."""

from __future__ import annotations

import pytest
import torch

from nerif.fields.network import Network, NeuralField
from nerif.fields.network_shape import NetworkShape
from nerif.geometry import Box, Rays
from nerif.reconstruction.neural.sampling import DENSITY_BINS, EVEN_SHARE, SamplingDensity, sample_count, sample_rays
from nerif.reconstruction.neural.training_data import shuffled

BOX = Box((-10.0, -10.0, -10.0), (10.0, 10.0, 10.0))


@pytest.mark.parametrize("count", [1, 2, 3, 17, 1024, 40_000])
def test_each_ray_occurs_once_per_epoch(count):
    for epoch in range(3):
        assert torch.equal(shuffled(epoch * count, count, count, 3).sort()[0], torch.arange(count))


def test_the_order_continues_from_any_place_and_across_epochs():
    parts = [shuffled(first, 60, 1000, 7) for first in range(0, 3000, 60)]
    assert torch.equal(torch.cat(parts), shuffled(0, 3000, 1000, 7))


def test_orders_differ_between_epochs_and_seeds_and_are_random():
    count = 100_000
    a, b, c = shuffled(0, count, count, 0), shuffled(count, count, count, 0), shuffled(0, count, count, 1)
    assert float((a == b).float().mean()) < 1e-3
    assert float((a == c).float().mean()) < 1e-3
    places = a.double()
    assert abs(float(torch.corrcoef(torch.stack([places[:-1], places[1:]]))[0, 1])) < 0.02
    # every tenth of the order has equally many of each tenth of the rays
    table = torch.histogramdd(torch.stack([torch.arange(count) / count, places / count], -1), [10, 10]).hist
    assert float((table / (count / 100) - 1).abs().max()) < 0.12


def rays(n: int = 400) -> Rays:
    """Through the box along x, at all heights and depths."""
    g = torch.Generator().manual_seed(0)
    origin = torch.cat([torch.full((n, 1), -100.0), 16 * torch.rand(n, 2, generator=g) - 8], dim=1)
    direction, none = torch.tensor([[1.0, 0.0, 0.0]]).expand(n, 3), torch.zeros(n)
    return Rays(origin, direction, none, none, torch.zeros(n, 2), torch.zeros(n, dtype=torch.int16), none).clip(BOX)


class Layer:
    """A field that varies in a thin layer at x = 3 mm only; in network coordinates, 1 for 10 mm."""

    height = 1.0

    def value(self, p):
        return self.height * torch.tanh((p[:, 0] - 0.3) / 0.1)

    def value_and_gradient(self, p, heads):
        slope = self.height * (1 - self.value(p).square()) / 0.1
        return self.value(p), torch.stack([slope, 0 * slope, 0 * slope], dim=1), None


def blank() -> SamplingDensity:
    return SamplingDensity(NeuralField(Network(NetworkShape(depth=1, width=4, octaves=0)), BOX, 1e-4))


@pytest.fixture
def density() -> SamplingDensity:
    density = blank()
    density.update(Layer())
    return density


def integral(sampling: str, seed: int, density: SamplingDensity) -> torch.Tensor:
    """Integral of the layer's slope along each ray; exactly 2."""
    r = rays()
    s, interval = sample_rays(r, 12, torch.Generator().manual_seed(seed), sampling, density)
    assert bool(((s > r.near[:, None] - 1e-4) & (s < r.far[:, None] + 1e-4)).all())
    slope = Layer().value_and_gradient(r.at(s).reshape(-1, 3) / 10, False)[1][:, 0].reshape(s.shape)
    return (slope * interval / 10).sum(1)


@pytest.mark.parametrize("sampling", ["random", "shifted", "adaptive"])
def test_random_samples_are_unbiased(density, sampling):
    values = torch.stack([integral(sampling, seed, density) for seed in range(20)])
    error = float(values.std()) / values.numel() ** 0.5
    assert float(values.mean()) == pytest.approx(2.0, abs=max(4 * error, 1e-3))


def test_adaptive_samples_scatter_least(density):
    scatter = {s: float(integral(s, 1, density).std()) for s in ("random", "shifted", "adaptive")}
    assert scatter["adaptive"] < 0.3 * min(scatter["shifted"], scatter["random"])


def test_the_density_is_high_at_the_layer_and_nowhere_zero(density):
    local = density.along(rays())
    assert local.shape == (400, DENSITY_BINS)
    torch.testing.assert_close(local.mean(1), torch.ones(400))
    assert float(local.min()) >= EVEN_SHARE * 0.99
    x = -10 + 20 * (torch.arange(DENSITY_BINS) + 0.5) / DENSITY_BINS
    assert abs(float(x[local[0].argmax()]) - 3) < 1.5


def test_intervals_fill_the_ray(density):
    r = rays(50)
    s, interval = sample_rays(r, 30, torch.Generator().manual_seed(0), "regular")
    torch.testing.assert_close(interval.sum(1), r.far - r.near)
    torch.testing.assert_close(s[:, 0] - r.near, interval[:, 0] / 2, rtol=0, atol=1e-4)
    # adaptive intervals do so on average over the shift
    draws = [sample_rays(r, 30, torch.Generator().manual_seed(k), "adaptive", density)[1].sum(1) for k in range(200)]
    torch.testing.assert_close(torch.stack(draws).mean(0), r.far - r.near, rtol=0.02, atol=0)


def test_without_variation_samples_are_even():
    a = sample_rays(rays(), 12, torch.Generator().manual_seed(2), "adaptive", blank())
    b = sample_rays(rays(), 12, torch.Generator().manual_seed(2), "shifted")
    assert all(torch.equal(x, y) for x, y in zip(a, b, strict=True))
    density, flat = blank(), Layer()
    flat.height = 0.0
    density.update(flat)
    torch.testing.assert_close(density.along(rays()), torch.ones(400, DENSITY_BINS))


@pytest.mark.parametrize(("progress", "counts"), [(0.0, range(8, 17)), (1.0, range(20, 29))])
def test_counts_grow_and_stay_within_the_jitter(progress, counts):
    g = torch.Generator().manual_seed(0)
    assert {sample_count(progress, 12, 24, 4, g) for _ in range(300)} == set(counts)
