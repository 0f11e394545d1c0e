"""Simulated measurements, sound and faulty, on which the verdict is tested (verdicts.py).

A case follows from its number alone: phantom, views, noise, fault. No fault shows in the file: the cameras are stated
as they should have been, the noise as it was thought to be.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, replace
from typing import Any

import torch

from benchmarks.random_flows import EDGE, random_flow
from benchmarks.runner import N_AMBIENT
from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Camera, Ring
from nerif.geometry.pose import GEOMETRY, Corrections
from nerif.simulation.simulate import simulate

FAULTS = ("nothing", "sigma halved", "sigma doubled", "camera knocked", "view mirrored", "flow beyond", "few views")
KNOCK = 1.0  # mm
SHRUNK = 0.6  # of the width of the box, where the flow extends beyond it
FAMILIES = {"gaussians": 4, "flame": 4, "octahedron": 1, "turbulence": 1, "fire": 1}
"""Phantoms and their relative frequency."""
RIGS = {"ring": 4, "general": 2, "lenses": 1}
"""Camera positions and their relative frequency: on an arc; tilted and rolled; on an arc, at f/8."""
F_NUMBER = 8.0
TILT, ROLL = 35.0, 20.0  # degrees, either way
LONG, LONGER = 6, 3  # one case in LONG has LONGER times the steps
INTEGRATION = 80  # steps of Runge-Kutta through the box


@dataclass(frozen=True)
class Case:
    """A measurement and its truth.

    Parameters
    ----------
    fault : one of FAULTS
    phantom : family
    noise : of the rms displacement
    measurement : with the fault
    rig : one of RIGS
    effort : factor on the steps of the training
    """

    fault: str
    phantom: str
    views: int
    noise: float
    measurement: Measurement
    truth: Field
    rig: str
    effort: int


def random_case(number: int, pixels: int = 40) -> Case:
    """Return the case of a number; one in three has no fault."""
    rng = random.Random(7919 * number + 13)
    fault = FAULTS[0] if number % 3 == 0 else FAULTS[1 + (number - number // 3 - 1) % (len(FAULTS) - 1)]
    (phantom,) = rng.choices(list(FAMILIES), list(FAMILIES.values()))
    views = rng.choice((2, 3, 4)) if fault == "few views" else rng.choice((6, 7, 9, 12))
    noise = rng.choice((0.02, 0.05, 0.1))
    box = Box.cube(EDGE)
    rng_rig = random.Random(15_485_863 * number + 11)
    (rig,) = rng_rig.choices(list(RIGS), list(RIGS.values()))
    field = make_phantom(phantom, box, 1000 + number, 0.0)
    if phantom == "flame" and rng_rig.random() < 0.5:
        phantom, field = "fronts", random_flow(number)[0]
    effort = LONGER if rng_rig.randrange(LONG) == 0 else 1
    cameras = _cameras(rig, views, pixels, rng_rig)
    measurement = simulate(field, cameras, box, N_AMBIENT, noise, seed=number, steps=INTEGRATION)
    faulty = _faulty(measurement, fault, field, rng, noise, number)
    return Case(fault, phantom, views, noise, faulty, field, rig, effort)


def _cameras(rig: str, views: int, pixels: int, rng: random.Random) -> tuple[Camera, ...]:
    """Return cameras over half a turn around the box."""
    sensor: dict[str, Any] = {"image_size": (pixels, pixels), "pixel_pitch": 4.0 / pixels}
    if rig != "general":
        ring = Ring(views=views, arc=(0.0, 180 * (1 - 1 / views)), **sensor)
        return ring.cameras(F_NUMBER if rig == "lenses" else 0.0)
    cameras = []
    for view in range(views):
        azimuth = round(180 * (view + rng.uniform(-0.4, 0.4)) / views, 2)
        one = Ring(views=1, arc=(azimuth, azimuth), elevation=rng.uniform(-TILT, TILT), **sensor)
        cameras.append(_rolled(one.cameras()[0], math.radians(rng.uniform(-ROLL, ROLL))))
    return tuple(cameras)


def _rolled(camera: Camera, angle: float) -> Camera:
    """Turn a camera about its optical axis, rad."""
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)


def _faulty(m: Measurement, fault: str, field: Field, rng: random.Random, noise: float, number: int) -> Measurement:
    view = rng.randrange(len(m.cameras))
    assert m.displacement is not None
    if fault in ("sigma halved", "sigma doubled"):
        factor = 0.5 if fault == "sigma halved" else 2.0
        return replace(m, sigma=None if m.sigma is None else m.sigma * factor)
    if fault == "camera knocked":
        values = torch.zeros(len(m.cameras), len(GEOMETRY), dtype=torch.float64)
        angle = rng.uniform(0, 2 * math.pi)  # across the line of sight, along which it would not show
        values[view, 3:5] = KNOCK * torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
        knocked = Corrections(m.cameras, values).corrected
        return replace(
            simulate(field, knocked, m.box, N_AMBIENT, noise, seed=number, steps=INTEGRATION), cameras=m.cameras
        )
    if fault == "view mirrored":
        displacement = m.displacement.clone()
        displacement[view] = displacement[view].flip(1) * torch.tensor([-1.0, 1.0])
        return replace(m, displacement=displacement)
    if fault == "flow beyond":
        return replace(m, box=Box((-SHRUNK * EDGE / 2, *m.box.lower[1:]), (SHRUNK * EDGE / 2, *m.box.upper[1:])))
    return m
