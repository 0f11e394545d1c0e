"""The drawing of refinement.md: how much of what a rig may be off by the data of nine views take away, kind by kind."""

from __future__ import annotations

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from nerif.analysis.prediction import predict
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Camera, paper_rig
from nerif.reconstruction.rig_refinement import Refinement
from nerif.reconstruction.uncertainty.rig_posterior import covariance
from nerif.simulation.simulate import add_noise

BLUE, ORANGE, INK, PALE = "#0072B2", "#E69F00", "#222222", "#DDDDDD"
VOXELS = 10  # along the box, on which the field follows
TURN, SHIFT = slice(0, 3), slice(3, 6)


def movements(cameras: tuple[Camera, ...], centre: Tensor) -> dict[str, Tensor]:
    """Kinds of movement, (view, 6) numbers each: of one camera in the middle of the rig, and of all of them."""
    one, views = len(cameras) // 2, len(cameras)

    def of_one(**numbers: float) -> Tensor:
        moved = torch.zeros(views, 6, dtype=torch.float64)
        for name, value in numbers.items():
            moved[one, ("turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z").index(name)] = value
        return moved

    away = float((cameras[one].rotation.double() @ (centre - cameras[one].centre.double()))[2])
    sideways = torch.zeros(views, 6, dtype=torch.float64)
    sideways[:, 3] = 1
    shifted, turned = torch.zeros_like(sideways), torch.zeros_like(sideways)
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    for v, camera in enumerate(cameras):
        rotation = camera.rotation.double()
        shifted[v, SHIFT] = rotation[:, 0]
        turned[v, TURN] = -rotation @ axis  # R' = R Q^T
        turned[v, SHIFT] = rotation @ torch.linalg.cross(axis, camera.centre.double() - centre)
    return {
        "one camera\nsideways": of_one(shift_x=1),
        "one camera\nupward": of_one(shift_y=1),
        "one camera\nturned sideways": of_one(turn_y=1),
        "one camera turned\nabout its axis": of_one(turn_z=1),
        "one camera\ntowards the flow": of_one(shift_z=1),
        "one camera, shift and\nturn that cancel there": of_one(shift_x=1, turn_y=1 / away),
        "all cameras\nsideways alike": sideways,
        "all together\nshifted": shifted,
        "all together turned\nabout the vertical": turned,
    }


def observable() -> Figure:
    """Standard deviation of each kind of movement afterwards, as a share of that beforehand."""
    cameras, box = paper_rig(24)
    field = make_phantom("gaussians", box, 0)
    measurement = add_noise(predict(field, cameras, box, 1.00027), 0.05, seed=1)
    rig = Refinement.for_measurement(measurement, ("cameras",), mm=0.5, deg=0.03)
    found, centre = covariance(rig, measurement, field, voxels=VOXELS), torch.tensor(box.centre, dtype=torch.float64)
    kinds = movements(tuple(cameras), centre)
    left = []
    for moved in kinds.values():
        own = (moved / rig.sigma[:, :6]).flatten()
        left.append(float((own @ found @ own / (own @ own)).clamp(min=0).sqrt()))
    figure = Figure(figsize=(9.2, 4.2), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    places, colours = range(len(kinds)), [BLUE if share < 0.7 else ORANGE for share in left]
    axes.barh(places, [1.0] * len(kinds), color=PALE, height=0.62)
    axes.barh(places, left, color=colours, height=0.62)
    for place, share in zip(places, left, strict=True):
        axes.text(share + 0.01, place, f"{share:.0%}", va="center", color=INK, fontsize=9)
    axes.set_yticks(places, list(kinds), fontsize=9)
    axes.invert_yaxis()
    axes.set(xlim=(0, 1.001), xlabel="standard deviation that the data leave, as a share of that of the calibration")
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(length=0)
    return figure
