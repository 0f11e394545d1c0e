"""Figures of the octahedron beside its MTF: the edge spread, and the resolution on its faces."""

from __future__ import annotations

import math
from itertools import product
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.study.resolution import SIZE, Resolution
from nerif.plotting.drawing import COLOURS, colour_range

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_edge_spread(axes: Axes, resolution: Resolution, label: str = "", colour: str = COLOURS["blue"]) -> Axes:
    """Draw the gradient across a face, averaged over all faces, over the true step."""
    distance = resolution.distance.numpy()
    axes.plot([distance[0], 0, 0, distance[-1]], [-1, -1, 0, 0], color=COLOURS["grey"], linewidth=0.8, linestyle="--")
    axes.plot(distance, resolution.edge_spread.numpy(), color=colour, label=label or None)
    axes.set_xlabel("distance from the face [mm]")
    axes.set_ylabel("gradient / true step [1]")
    if label:
        axes.legend(frameon=False)
    return axes


def draw_distribution(axes: Axes, resolution: Resolution, limits: tuple[float, float] | None = None) -> Axes:
    """Draw the resolution on the eight faces, unfolded side by side: x+ y+ first, those of z+ above.

    The colour bar is in lp/unit; a patch finer than the samples resolve is grey. The outlines are the whole faces.
    """
    from matplotlib import colormaps
    from matplotlib.collections import PolyCollection

    signs = torch.tensor(list(product((1.0, -1.0), repeat=3)), dtype=torch.float64)
    centre = resolution.patches.mean(dim=(0, 1))
    faces = signs[:, None] * torch.eye(3, dtype=torch.float64) * (SIZE * resolution.unit)
    outlines = _unfold(faces, signs, resolution.unit).numpy()
    patches = _unfold(resolution.patches - centre, resolution.normals.sign(), resolution.unit).numpy()

    axes.add_collection(PolyCollection(list(outlines), facecolors="none", edgecolors=COLOURS["grey"], linewidths=0.8))
    values = resolution.local_lp_per_unit.numpy()
    low, high = limits or colour_range(values)
    collection = PolyCollection(list(patches), array=values, edgecolors="face")
    collection.set_cmap(colormaps["viridis"].with_extremes(bad="0.7"))
    collection.set_clim(low, high)
    axes.add_collection(collection)
    for face, sign in zip(outlines, signs.int().tolist(), strict=True):
        name = " ".join(f"{axis}{'+' if s > 0 else '-'}" for axis, s in zip("xyz", sign, strict=True))
        middle, tip = face[:, 0].mean(), face[2, 1]
        axes.annotate(
            name, (middle, tip), (0, 2 if tip > 0 else -2), textcoords="offset points", fontsize="small", ha="center",
            va="bottom" if tip > 0 else "top",
        )  # fmt: skip
    axes.set_aspect("equal")
    axes.margins(0.03, 0.16)
    axes.autoscale_view()
    axes.set_xlabel("around the z axis [mm]")
    axes.set_ylabel("up the faces [mm]")
    beyond = (bool((values < low).any()), bool((values > high).any()))
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get(beyond, "neither")
    bar = axes.figure.colorbar(collection, ax=axes, shrink=0.9, pad=0.02, extend=extend)
    bar.set_label("resolution, MTF at 10 % [lp/unit]")
    return axes


def _unfold(triangles: Float[Tensor, "k 3 3"], signs: Float[Tensor, "k 3"], unit: float) -> Float[Tensor, "k 3 2"]:
    """Lay triangles on the faces of given signs, corners from the centre, side by side into a plane; mm.

    The corner of the z axis is the tip of a face; those of the x and y axes lie on the line of the others' bases.
    """
    weights = triangles.abs() / (SIZE * unit)
    x, y, z = weights.unbind(-1)
    quadrant = ((signs[:, 1] < 0) * 2 + (signs[:, 0] * signs[:, 1] < 0))[:, None]
    edge = SIZE * math.sqrt(2) * unit
    across = quadrant + torch.where(quadrant % 2 == 0, y, x) + z / 2
    return torch.stack([across * edge, signs[:, None, 2] * z * edge * (math.sqrt(3) / 2)], dim=-1)
