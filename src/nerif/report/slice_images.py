"""Slices of a volume, and colour bars, as small images for a page."""

from __future__ import annotations

import numpy as np

from nerif.data.volume import Volume
from nerif.geometry import Box
from nerif.plotting.drawing import PLANES
from nerif.report.view_images import image_address

__all__ = ["bar_image", "slice_aspect", "slice_axes", "slice_image"]


def slice_image(volume: Volume, normal: str, index: int, limits: tuple[float, float], colours: str) -> str:
    """Return a slice as a PNG in a data address, one pixel per voxel, masked voxels grey.

    Parameters
    ----------
    normal : x, y or z
    index : of the voxel along it
    limits : ends of the colours, of values as shown (drawing.shown)
    colours : name of a Matplotlib colour map
    """
    axis = "zyx".index(normal)
    index = min(max(index, 0), volume.grid.shape[axis] - 1)
    plane = np.take(volume.values.numpy(), index, axis=axis)
    if volume.quantity == "n":
        plane = plane.astype(np.float64) - 1
    return image_address(plane[::-1], limits, colours)


def slice_aspect(volume: Volume, normal: str) -> float:
    """Return width over height of the slice across an axis."""
    across, up = PLANES[normal]
    edges = volume.grid.box.edges
    return edges["xyz".index(across)] / edges["xyz".index(up)]


def slice_axes(box: Box, normal: str) -> str:
    """Return the axes of the slice across an axis in words, to the right and up, with their ends, mm."""
    ends = {axis: f"{axis} {low:g} to {high:g} mm" for axis, low, high in zip("xyz", box.lower, box.upper, strict=True)}
    across, up = PLANES[normal]
    return f"{ends[across]} →, {ends[up]} ↑"


def bar_image(colours: str) -> str:
    """Return a colour bar, low on the left, as a PNG in a data address."""
    return image_address(np.linspace(0.0, 1.0, 256)[None], (0.0, 1.0), colours)
