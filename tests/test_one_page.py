"""examples/nerif_in_one_page.py computes the loss and the gradient of the package on the same batch."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
import torch
import xarray

from nerif.geometry import Ring
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.sampling import Batch, RayBatch
from nerif.reconstruction.neural.trainer import Trainer
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.simulation.simulate import simulate

PAGE = Path(__file__).parents[1] / "examples" / "nerif_in_one_page.py"


def test_one_page_has_the_loss_and_gradient_of_the_package(tmp_path, ball, box) -> None:
    spec = importlib.util.spec_from_file_location("nerif_in_one_page", PAGE)
    assert spec is not None
    assert spec.loader is not None
    page = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(page)

    ring = Ring(views=4, arc=(0.0, 135.0), elevation=6.0, image_size=(18, 24), pixel_pitch=0.12)
    measurement = simulate(ball, ring.cameras(), box, n_ambient=1.00027, noise=0.02, seed=3, steps=40)
    measurement.write(tmp_path / "m.nc")
    with xarray.open_dataset(tmp_path / "m.nc") as file:
        rays = page.read_rays(file)
    settings = NeRIF(
        wave_pixels=0.0, sampling="random", optimiser="adam", compile="off", precision="float32", device="cpu"
    )
    training = Trainer(settings, TrainingData(settings, measurement, coarsest=1))
    theirs, network = training.field, page.Network()
    network.load_state_dict({k: v for k, v in theirs.network.state_dict().items() if k in network.state_dict()})
    field = page.Field(network, torch.tensor(box.centre).float(), theirs.half_edge, theirs.scale, 1.00027)

    generator = torch.Generator().manual_seed(1)
    index = torch.randperm(len(rays.near), generator=generator)[:200]
    batch = page.Rays(*(column[index] for column in rays))
    s, interval = page.sample(batch, 16, generator)
    (part,) = training.data.batch(index)
    assert torch.allclose(part.rays.direction, batch.direction, atol=1e-6)
    ambient = training.data.gauge.sample(256, torch.Generator().manual_seed(2))[0]
    size = float(rays.displacement.square().mean().sqrt())
    ours = page.loss(field, batch, s, interval, ambient, size)
    ours.backward()

    piece = RayBatch(part, part.rays, s, interval, part.measured.numel())
    training.objective.gauge_errors = lambda count, _: theirs.network(theirs.normalise(ambient))  # the same points
    loss, _ = training.objective(Batch([piece], piece.numbers))
    loss.backward()
    assert ours.item() == pytest.approx(loss.item(), rel=1e-4)
    gradients = dict(theirs.network.named_parameters())
    for name, weight in network.named_parameters():
        other = gradients[name].grad
        assert torch.allclose(weight.grad, other, rtol=1e-3, atol=1e-4 * float(other.abs().max())), name
