"""Pixels drawn at random: as many as asked, of every technique and view some, the same every time."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerif.data.measurement import Measurement, measurement_of
from nerif.forward.deflection import Deflection
from nerif.forward.interferometry import Interferometry
from nerif.geometry import paper_rig
from nerif.reconstruction.neural.some_pixels import some_pixels


@pytest.fixture(scope="module")
def both() -> Measurement:
    """Two views of displacements, and of fringes one with few pixels and one with none."""
    cameras, box = paper_rig(60)
    fringes = torch.full((2, 60, 60, 1), torch.nan)
    fringes[0, 20:22, 30:40] = 1.0
    seen = {Deflection: torch.ones(2, 60, 60, 2), Interferometry: fringes}
    return measurement_of(seen, cameras[:2], box, 1.00027, 532.0)


def counts(measurement: Measurement) -> list[list[int]]:
    return [measurement.usable_for(o).flatten(1).sum(dim=1).tolist() for o in measurement.observations]


def test_about_so_many_and_of_every_technique_and_view_some(both):
    (first, second), fringes = counts(some_pixels(both, 1000))
    assert 800 < first + second < 1200
    assert fringes == [20, 0]  # too few to choose from
    assert torch.equal(some_pixels(both, 1000).usable, some_pixels(both, 1000).usable)


def test_a_view_of_a_single_pixel_keeps_it(both):
    valid = torch.ones(2, 60, 60, dtype=torch.bool)
    valid[1] = False
    valid[1, 3, 4] = True
    lonely = replace(both, valid=valid)
    assert counts(some_pixels(lonely, 100))[0][1] == 1
