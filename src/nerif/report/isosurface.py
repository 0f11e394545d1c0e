"""An isosurface in a Matplotlib figure, for print."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from nerif.data.volume import Volume
from nerif.plotting.drawing import colour_range, shown

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D

__all__ = ["default_level", "draw_isosurface", "filled", "stl_of", "surface_triangles"]

LARGEST = 80  # voxels along an edge: finer surfaces cannot be told apart in print, and take minutes to draw
FACE = "#E69F00"


def default_level(volume: Volume) -> float:
    """Return the value halfway between the ambient (median of the faces of the box) and what is farthest from it.

    A few outliers do not count: see drawing.colour_range.
    """
    values = shown(volume)
    faces = np.concatenate([np.take(values, i, axis=a).ravel() for a in range(3) for i in (0, -1)])
    ambient = float(np.nanmedian(faces)) if np.isfinite(faces).any() else 0.0
    return ambient + 0.5 * max((end - ambient for end in colour_range(values)), key=abs)


def surface_triangles(volume: Volume, level: float) -> Float[np.ndarray, "n 3 3"]:
    """Return the corners (mm) of triangles on which a quantity has the value `level`; none where it is nowhere met."""
    from skimage.measure import marching_cubes

    stride = max(1, -(-max(volume.grid.shape) // LARGEST))
    values = shown(volume)[::stride, ::stride, ::stride]
    values = filled(values)
    if min(values.shape) < 2 or not values.min() < level < values.max():
        return np.zeros((0, 3, 3))
    vertices, faces, _, _ = marching_cubes(values, level)
    first = np.array([float(volume.grid.axis(a)[0]) for a in "xyz"])
    return (vertices[:, ::-1] * np.array(volume.grid.spacing) * stride + first)[faces]


def stl_of(triangles: Float[np.ndarray, "n 3 3"]) -> bytes:
    """Return triangles (mm) as a binary STL file, which CAD programs and three.js read."""
    a, b, c = (triangles[:, i] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    records = np.zeros(len(triangles), dtype=[("numbers", "<f4", (4, 3)), ("attribute", "<u2")])
    records["numbers"] = np.concatenate([normals[:, None], triangles], axis=1)
    return b"nerif, mm".ljust(80) + np.uint32(len(triangles)).tobytes() + records.tobytes()


def filled(values: Float[np.ndarray, "z y x"]) -> Float[np.ndarray, "z y x"]:
    """Return masked voxels (NaN) with the value of the nearest that is not: they must have no surface of their own."""
    from scipy.ndimage import distance_transform_edt

    masked = ~np.isfinite(values)
    if masked.all() or not masked.any():
        return np.nan_to_num(values)
    nearest = distance_transform_edt(masked, return_distances=False, return_indices=True)
    return values[tuple(nearest)]


def draw_isosurface(axes: Axes3D, volume: Volume, level: float) -> Axes3D:
    """Draw the surface on which a quantity has the value `level` (in its unit), lit from the viewer; lengths in mm."""
    from matplotlib.colors import LightSource
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    triangles = surface_triangles(volume, level)
    if len(triangles):
        surface = Poly3DCollection(
            triangles,
            facecolors=FACE,
            edgecolors=FACE,  # else the ground shines through between triangles
            linewidths=0.2,
            shade=True,
            lightsource=LightSource(azdeg=225, altdeg=45),
            rasterized=True,
        )
        axes.add_collection3d(surface)
    box = volume.grid.box
    axes.set_xlim(box.lower[0], box.upper[0])
    axes.set_ylim(box.lower[1], box.upper[1])
    axes.set_zlim(box.lower[2], box.upper[2])
    axes.set_box_aspect(box.edges, zoom=0.88)
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("y [mm]")
    axes.set_zlabel("z [mm]")
    return axes
