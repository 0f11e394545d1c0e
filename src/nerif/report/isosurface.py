"""Isosurfaces: triangles, an STL file, and a drawing for print."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from nerif.common.arrays import filled
from nerif.data.volume import Volume
from nerif.plotting.drawing import colour_range, plotted_values

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D

__all__ = ["default_level", "draw_isosurface", "stl_of", "surface_triangles"]

MAX_VOXELS = 80  # along an edge: finer surfaces look the same in print and take minutes to draw
FACE = "#E69F00"


def default_level(volume: Volume) -> float:
    """Return the value halfway between the ambient (median on the faces) and the extreme, outliers excluded."""
    values = plotted_values(volume)
    faces = np.concatenate([np.take(values, i, axis=a).ravel() for a in range(3) for i in (0, -1)])
    ambient = float(np.nanmedian(faces)) if np.isfinite(faces).any() else 0.0
    return ambient + 0.5 * max((end - ambient for end in colour_range(values)), key=abs)


def surface_triangles(volume: Volume, level: float) -> Float[np.ndarray, "n 3 3"]:
    """Return the corners (mm) of the triangles of an isosurface; none where the level is not reached."""
    from skimage.measure import marching_cubes

    stride = max(1, -(-max(volume.grid.shape) // MAX_VOXELS))
    values = filled(plotted_values(volume)[::stride, ::stride, ::stride])
    if min(values.shape) < 2 or not values.min() < level < values.max():
        return np.zeros((0, 3, 3))
    vertices, faces, _, _ = marching_cubes(values, level)
    first = np.array([float(volume.grid.axis(a)[0]) for a in "xyz"])
    return (vertices[:, ::-1] * np.array(volume.grid.spacing) * stride + first)[faces]


def stl_of(triangles: Float[np.ndarray, "n 3 3"]) -> bytes:
    """Return triangles (mm) as a binary STL file."""
    a, b, c = (triangles[:, i] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    records = np.zeros(len(triangles), dtype=[("numbers", "<f4", (4, 3)), ("attribute", "<u2")])
    records["numbers"] = np.concatenate([normals[:, None], triangles], axis=1)
    return b"nerif, mm".ljust(80) + np.uint32(len(triangles)).tobytes() + records.tobytes()


def draw_isosurface(axes: Axes3D, volume: Volume, level: float) -> Axes3D:
    """Draw an isosurface (level in the plotted unit), lit from the viewer; lengths in mm."""
    from matplotlib.colors import LightSource
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    triangles = surface_triangles(volume, level)
    if len(triangles):
        light = LightSource(azdeg=225, altdeg=45)
        # coloured edges hide the gaps between triangles
        surface = Poly3DCollection(
            triangles, facecolors=FACE, edgecolors=FACE, linewidths=0.2, shade=True, lightsource=light, rasterized=True
        )
        axes.add_collection3d(surface)
    box = volume.grid.box
    limits = zip(box.lower, box.upper, strict=True)
    axes.set(**dict(zip(("xlim", "ylim", "zlim"), limits, strict=True)))
    axes.set_box_aspect(box.edges, zoom=0.88)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    return axes
