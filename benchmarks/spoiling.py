"""Simulated measurements, good ones and spoiled ones, of which a verdict is to tell one from the other.

A case is drawn from its number alone: phantom, views, noise, what is wrong. What is wrong never shows in the file: the
cameras are stated as they should have been, the noise as it was thought to be.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from bench import N_AMBIENT
from nerif.data.measurement import Measurement
from nerif.fields.base import Field
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Camera, Ring
from nerif.geometry.pose import GEOMETRY, Corrections
from nerif.simulation.simulate import simulate
from random_flows import random_flow

__all__ = ["SPOILED", "Case", "case"]

SPOILED = ("nothing", "sigma halved", "sigma doubled", "camera knocked", "view mirrored", "flow beyond", "few views")
"""What may be wrong."""

EDGE = 50.0  # mm
KNOCK = 1.0  # mm
SHRUNK = 0.6  # of the width of the box, where flow goes on beyond it
FAMILIES = {"gaussians": 4, "flame": 4, "octahedron": 1, "turbulence": 1, "fire": 1}
"""Phantoms, and how often each is drawn."""

RIGS = {"ring": 4, "general": 2, "lenses": 1}
"""Where the cameras stand, and how often: on an arc; in general position, tilted and rolled; on an arc, at f/8."""

F_NUMBER = 8.0
TILT, ROLL = 35.0, 20.0  # degrees, either way
LONG = 6  # one case in so many has LONGER times the steps
LONGER = 3
INTEGRATION = 80  # steps of Runge-Kutta through the box


@dataclass(frozen=True)
class Case:
    """One measurement, and the truth.

    Parameters
    ----------
    number : from which all the rest was drawn
    wrong : one of SPOILED
    phantom : family
    views : how many
    noise : of the rms displacement
    measurement : as it is found in a file
    truth : field
    rig : one of RIGS
    effort : factor on the steps of the training
    """

    number: int
    wrong: str
    phantom: str
    views: int
    noise: float
    measurement: Measurement
    truth: Field
    rig: str = "ring"
    effort: int = 1


def case(number: int, pixels: int = 40) -> Case:
    """Draw a case from its number; one in three is good."""
    drawn = random.Random(7919 * number + 13)
    wrong = SPOILED[0] if number % 3 == 0 else SPOILED[1 + (number - number // 3 - 1) % (len(SPOILED) - 1)]
    (phantom,) = drawn.choices(list(FAMILIES), list(FAMILIES.values()))
    views = drawn.choice((2, 3, 4)) if wrong == "few views" else drawn.choice((6, 7, 9, 12))
    noise = drawn.choice((0.02, 0.05, 0.1))
    box = Box.cube(EDGE)
    others = random.Random(15_485_863 * number + 11)
    (rig,) = others.choices(list(RIGS), list(RIGS.values()))
    field = make_phantom(phantom, box, 1000 + number, 0.0)
    if phantom == "flame" and others.random() < 0.5:
        phantom, field = "fronts", random_flow(number).truth
    effort = LONGER if others.randrange(LONG) == 0 else 1
    cameras = _cameras(rig, views, pixels, others)
    measurement = simulate(field, cameras, box, N_AMBIENT, noise, seed=number, steps=INTEGRATION)
    spoiled = _spoiled(measurement, wrong, field, drawn, noise, number)
    return Case(number, wrong, phantom, views, noise, spoiled, field, rig, effort)


def _cameras(rig: str, views: int, pixels: int, drawn: random.Random) -> tuple[Camera, ...]:
    """The cameras of a rig: half a turn around the box, or as far apart but tilted and rolled."""
    kind: dict[str, Any] = {"image_size": (pixels, pixels), "pixel_pitch": 4.0 / pixels}
    if rig != "general":
        ring = Ring(views=views, arc=(0.0, 180 * (1 - 1 / views)), **kind)
        return ring.cameras(F_NUMBER if rig == "lenses" else 0.0)
    cameras = []
    for view in range(views):
        azimuth = round(180 * (view + drawn.uniform(-0.4, 0.4)) / views, 2)
        one = Ring(views=1, arc=(azimuth, azimuth), elevation=drawn.uniform(-TILT, TILT), **kind)
        cameras.append(_rolled(one.cameras()[0], math.radians(drawn.uniform(-ROLL, ROLL))))
    return tuple(cameras)


def _rolled(camera: Camera, angle: float) -> Camera:
    """A camera turned about its optical axis, rad."""
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)


def _spoiled(m: Measurement, wrong: str, field: Field, drawn: random.Random, noise: float, number: int) -> Measurement:
    """The measurement with what is wrong."""
    view = drawn.randrange(len(m.cameras))
    assert m.displacement is not None
    if wrong == "sigma halved":
        return replace(m, sigma=None if m.sigma is None else m.sigma / 2)
    if wrong == "sigma doubled":
        return replace(m, sigma=None if m.sigma is None else m.sigma * 2)
    if wrong == "camera knocked":
        values = torch.zeros(len(m.cameras), len(GEOMETRY), dtype=torch.float64)
        angle = drawn.uniform(0, 2 * math.pi)  # across the line of sight, along which it would not show
        values[view, 3:5] = KNOCK * torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
        there = Corrections(m.cameras, values).corrected
        seen = simulate(field, there, m.box, N_AMBIENT, noise, seed=number, steps=INTEGRATION)
        return replace(seen, cameras=m.cameras)
    if wrong == "view mirrored":
        return replace(m, displacement=_mirrored(m.displacement, view))
    if wrong == "flow beyond":
        return replace(m, box=Box((-SHRUNK * EDGE / 2, *m.box.lower[1:]), (SHRUNK * EDGE / 2, *m.box.upper[1:])))
    return m


def _mirrored(displacement: Tensor, view: int) -> Tensor:
    """One view with left and right exchanged."""
    found = displacement.clone()
    found[view] = found[view].flip(1) * torch.tensor([-1.0, 1.0])
    return found
