"""Densities of a film improved by its displacements and a flow that is known exactly."""

from __future__ import annotations

from functools import lru_cache

import pytest
import torch

from nerif.fields.voxel_field import VoxelField
from nerif.flow.advected_scalar import between
from nerif.flow.film_density import FilmDensity
from nerif.flow.frame_resampling import smooth
from nerif.flow.periodic_box import PeriodicBox
from nerif.flow.transport import Transport
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.projector import Projector
from nerif.simulation.simulate import simulate
from refusals import refused

GRID = Grid(Box((-17.0, -16.0, -20.0), (17.0, 16.0, 20.0)), (20, 16, 17))  # 17: no size of fast transforms
TIMES = tuple(0.005 * k for k in range(6))
RISE = 400.0  # mm/s: one voxel per interval
N_AMBIENT = 1.00027
FACES = ("x-", "x+", "y-", "y+")


def rings() -> torch.Tensor:
    x, y, z = GRID.points(torch.float32).unbind(-1)
    radius = (x**2 + y**2).sqrt()
    return torch.stack([
        0.1 * torch.exp(-(((radius - 5.0) / 3.0) ** 2) - ((z + 5.0 - RISE * t) / 4.0) ** 2) for t in TIMES
    ])  # fmt: skip


@lru_cache(maxsize=1)
def projectors() -> tuple[Projector, ...]:
    """Three views of the rings, with much noise."""
    cameras = Ring(views=3, image_size=(20, 24), pixel_pitch=0.16).cameras()
    measurements = [
        simulate(VoxelField.through((1 - N_AMBIENT) * volume, GRID), cameras, GRID.box, N_AMBIENT, 0.3,
                 seed=k, steps=30, ambient_faces=FACES)
        for k, volume in enumerate(rings())
    ]  # fmt: skip
    return tuple(Projector(m, GRID) for m in measurements)


def improved(film: torch.Tensor, rise: float) -> torch.Tensor:
    box = PeriodicBox(GRID)
    velocity = torch.zeros(len(TIMES), 3, *box.shape)
    velocity[:, 2] = rise
    transport = Transport(film, GRID, TIMES, torch.zeros_like(film), box)
    splines = box.spline(box.spectrum(velocity))
    return FilmDensity(film, GRID, projectors(), N_AMBIENT)(transport, splines)


def error(theta: torch.Tensor) -> float:
    return float((theta - rings()).norm() / rings().norm())


def test_frames_share_what_they_know_through_the_flow():
    generator = torch.Generator().manual_seed(0)
    film = rings() + 0.01 * smooth(torch.randn(len(TIMES), *GRID.shape, generator=generator), (1.0, 1.0, 1.0)) * 3
    before, together, wrong = error(film), error(improved(film, RISE)), error(improved(film, -RISE))
    assert together < 0.7 * before
    assert together < 0.8 * wrong


def test_iterations_reduce_the_residual_of_the_displacements():
    film = 0.8 * rings()
    box = PeriodicBox(GRID)
    residuals: list[float] = []
    splines = torch.zeros(len(TIMES), 3, *box.shape)
    splines[:, 2] = RISE
    density = FilmDensity(film, GRID, projectors(), N_AMBIENT, iterations=12)
    density(
        Transport(film, GRID, TIMES, torch.zeros_like(film), box),
        splines,
        lambda _, misfit: residuals.append(misfit) or False,
    )
    assert len(residuals) == 12
    assert residuals[-1] < residuals[0]
    assert residuals[-1] == pytest.approx(1.0, abs=0.1)


def test_a_withheld_frame_is_carried_there():
    theta = rings()
    velocity = torch.zeros(3, *GRID.shape)
    velocity[2] = RISE
    velocity[:, 0, 0, 0] = torch.nan
    seconds = TIMES[4] - TIMES[0]
    carried, linear = between(theta[0], theta[4], velocity, GRID, seconds), 0.5 * (theta[0] + theta[4])
    assert float((carried - theta[2]).norm()) < 0.05 * float((linear - theta[2]).norm())
    later = between(theta[0], theta[4], velocity, GRID, seconds, 0.75)
    assert float((later - theta[3]).norm()) < 0.05 * float(theta[3].norm())
    with refused("fraction"):
        between(theta[0], theta[4], velocity, GRID, seconds, 2.0)
