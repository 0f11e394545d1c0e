"""One camera and a flow with an axis: inverse Abel transforms, each with its best options, beside nerif.

    python benchmarks/one_camera.py --write benchmarks/results/one-camera-cpu.md

A camera sees a jet, a plume and an underexpanded jet through rays that are nearly parallel, or spread by a half field
of view of 5 or 10 degrees. The transforms (abel_peers.py; they need PyAbel: pip install -c constraints.txt -e
'.[benchmarks]') are given the axis and the geometry, and of their smoothing, regularisation and interpolation whatever
comes nearest to the truth, draw by draw of the noise: more than a user has. nerif is given the same axis, and never the
truth.

L2 and L2 of the variation are over the volume that a map turns into around the axis, from 10 to 90 % of the height of
the box: the simulated flow ends where the box does, which only a method that knows the box can tell.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from dataclasses import dataclass
from typing import Any

from abel_peers import ORDERS, PEERS, ParallelView, Peer, Revolution, attempts, pyabel
from bench import N_AMBIENT, Table, add_write
from nerif.analysis.evaluation import evaluate_volume
from nerif.analysis.metrics import volume_errors
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.base import Field
from nerif.fields.jets import AXISYMMETRIC
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Camera, Grid, Ring
from nerif.reconstruction.base import Reconstructor
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.simulation.simulate import add_noise, simulate

BOX = Box.cube(50.0)
EVALUATED = Box((-25.0, -25.0, -20.0), (25.0, 25.0, 20.0))
BACKGROUND, SENSOR = 500.0, 4.0  # axis to background, width of the sensor, mm
OURS = ("NeRIF", "Tikhonov", "TV")


@dataclass(frozen=True)
class Score:
    """How near a method came.

    Parameters
    ----------
    l2, variation : L2, and L2 of the variation
    options : with which, in words
    """

    l2: float
    variation: float
    options: str = ""


def camera_of(half_angle: float, pixels: int) -> Camera:
    """Return a camera with a half field of view (degrees) so far away that it sees the box whole."""
    tangent, edge = math.tan(math.radians(half_angle)), BOX.edges[0] / 2
    ring = Ring(
        views=1,
        arc=(0.0, 0.0),
        focal_length=SENSOR / 2 / tangent,
        pixel_pitch=SENSOR / pixels,
        image_size=(pixels, pixels),
        distance=edge + 1.04 * edge / tangent,
        background_distance=BACKGROUND,
    )
    return ring.cameras()[0]


def scored(truth: Volume, test: Any, options: str) -> Score:
    """Return the score of a volume of index excess."""
    errors = volume_errors(truth.values.numpy(), test, N_AMBIENT)
    return Score(errors["l2"], errors["l2_variation"], options)


def best_of(peer: Peer, measurement: Measurement, truth: Volume) -> Score:
    """Return the score of a method with the options that come nearest to the truth."""
    camera = measurement.cameras[0]
    displacement, view = measurement.displacements[0].numpy(), ParallelView.of(camera, BOX.centre)
    found = list(attempts(peer, displacement, view, N_AMBIENT))
    best: list[Score] = []
    for order, read in ORDERS.items():
        turned = Revolution(view, found[0][1].shape, truth.grid, order)
        best += (scored(truth, turned(map_), f"{options}, {read}") for options, map_ in found)
    return min(best, key=lambda score: score.l2)


def methods(time_limit: float, voxels: int, seed: int, device: str) -> dict[str, Reconstructor]:
    """Return nerif's methods, held to the axis of the box."""
    axis: dict[str, Any] = {"symmetry": "axis", "device": device}
    return {
        "NeRIF": NeRIF(time_limit=time_limit, seed=seed, **axis),
        "Tikhonov": Tikhonov(voxels=voxels, **axis),
        "TV": TotalVariation(voxels=voxels, **axis),
    }


def ours(measurement: Measurement, asked: argparse.Namespace, seed: int) -> dict[str, Field]:
    """Return the fields that nerif's methods find."""
    found = methods(asked.time_limit, asked.voxels, seed, asked.device)
    return {name: method(measurement).field for name, method in found.items() if name in asked.methods}


def scores(clean: Measurement, truth: Volume, noise: float, seed: int, asked: argparse.Namespace) -> dict[str, Score]:
    """Return the scores of all methods that are asked for, of one draw of noise."""
    measurement = add_noise(clean, noise, seed)
    found: dict[str, Score] = {}
    if "peers" in asked.only:
        found |= {peer.title: best_of(peer, measurement, truth) for peer in PEERS}
    if "ours" in asked.only:
        for name, field in ours(measurement, asked, seed).items():
            errors = evaluate_volume(field, truth, N_AMBIENT, asked.device)
            found[name] = Score(errors["l2"], errors["l2_variation"])
    return found


def median_of(draws: list[Score]) -> Score:
    """Return the medians of several draws, with the options of the first."""
    l2, variation = (statistics.median(values) for values in zip(*((s.l2, s.variation) for s in draws), strict=True))
    return Score(l2, variation, draws[0].options)


def cells(found: dict[str, Score]) -> list[str]:
    """Return the cells of a row behind what was seen."""
    peers = {name: score for name, score in found.items() if name not in OURS}
    mine = [score for name, score in found.items() if name in OURS]
    row = []
    if peers:
        best = min(peers, key=lambda name: peers[name].l2)
        row.append(f"{best}; {peers[best].options}")
    row += [f"{score.l2:.3%} ({score.variation:.1%})" for score in found.values()]
    if peers and mine:
        row.append(f"{peers[best].l2 / min(score.l2 for score in mine):.2f}")
    return row


def options() -> argparse.ArgumentParser:
    """Return the options."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--phantom", nargs="+", default=list(AXISYMMETRIC), choices=list(AXISYMMETRIC))
    parser.add_argument("--noise", type=float, nargs="+", default=[0.02, 0.05, 0.15], help="share of the rms")
    parser.add_argument("--half-angle", type=float, nargs="+", default=[1.0, 5.0, 10.0], help="degrees")
    parser.add_argument("--pixels", type=int, default=100, help="of an edge of the image")
    parser.add_argument("--seeds", type=int, default=3, help="of noise and training, whose median is shown")
    parser.add_argument("--only", nargs="+", default=["peers", "ours"], choices=["peers", "ours"])
    parser.add_argument("--methods", nargs="+", default=list(OURS), choices=OURS, help="of ours")
    parser.add_argument("--time-limit", type=float, default=30.0, help="seconds for NeRIF")
    parser.add_argument("--voxels", type=int, default=100, help="of Tikhonov and TV, along an edge")
    parser.add_argument("--truth-voxels", type=int, default=100, help="of the truth, along an edge")
    parser.add_argument("--device", default="cpu")
    add_write(parser)
    return parser


def main() -> None:
    """Run and print the table."""
    asked = options().parse_args()
    if "peers" in asked.only:
        try:
            pyabel()
        except InputError as error:
            sys.exit(f"one_camera: {error}; or --only ours")
    grid = Grid.of_resolution(EVALUATED, asked.truth_voxels)
    names = [peer.title for peer in PEERS] * ("peers" in asked.only) + [
        name for name in OURS if "ours" in asked.only and name in asked.methods
    ]
    columns = ["phantom", "noise", "half field of view", *["best peer"] * ("peers" in asked.only), *names]
    columns += ["L2, best peer over best of ours"] * (len(set(asked.only)) > 1)
    title = f"One camera of {asked.pixels}² px, L2 (L2 of the variation), medians of {asked.seeds}"
    table = Table(title, columns, asked.write)
    for phantom in asked.phantom:
        field = make_phantom(phantom, BOX)
        truth = Volume(field.sample(grid), grid)
        for half_angle in asked.half_angle:
            clean = simulate(field, [camera_of(half_angle, asked.pixels)], BOX, N_AMBIENT)
            for noise in asked.noise:
                draws = [scores(clean, truth, noise, seed, asked) for seed in range(asked.seeds)]
                found = {name: median_of([draw[name] for draw in draws]) for name in draws[0]}
                table.row([phantom, f"{noise:g}", f"{half_angle:g}°", *cells(found)])


if __name__ == "__main__":
    main()
