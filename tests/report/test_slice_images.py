"""Slices as small images, and surfaces as STL."""

from __future__ import annotations

import base64
import io

import imageio.v3 as iio
import numpy as np
import torch

from nerif.data.volume import Volume
from nerif.geometry import Box, Grid
from nerif.report.isosurface import stl_of
from nerif.report.slice_images import bar_image, slice_aspect, slice_image


def pixels(address: str) -> np.ndarray:
    """Red, green, blue of a data address."""
    return iio.imread(io.BytesIO(base64.b64decode(address.partition(",")[2])))[..., :3].astype(int)


def test_a_slice_stands_upright_and_is_cut_where_it_is_asked_for():
    values = torch.zeros(5, 4, 3)
    values[4, 1, 2], values[0, 0, 0] = 1.0, torch.nan
    volume = Volume(values, Grid(Box((0, 0, 0), (6, 4, 10)), (5, 4, 3)), "density", "kg m-3")
    across_y = pixels(slice_image(volume, "y", 1, (0.0, 1.0), "gray"))
    assert across_y.shape == (5, 3, 3)
    assert across_y[0, 2].tolist() == [255] * 3  # the highest z above, x to the right
    assert across_y.sum() == 3 * 255
    across_x = pixels(slice_image(volume, "x", -7, (0.0, 1.0), "gray"))  # the outermost, where there is none
    assert across_x[4, 0].tolist() == [190] * 3
    assert slice_aspect(volume, "y") == 0.6
    assert pixels(bar_image("gray"))[0, [0, -1], 0].tolist() == [0, 255]


def test_the_index_is_drawn_as_what_it_is_beyond_one():
    volume = Volume(torch.full((2, 3, 4), 1.0003, dtype=torch.float64), Grid(Box.cube(2), (2, 3, 4)), "n")
    drawn = pixels(slice_image(volume, "z", 0, (0.0002, 0.0004), "gray"))
    assert 120 < drawn.mean() < 135


def test_triangles_as_stl():
    corners = np.array([[[0, 0, 0], [2, 0, 0], [0, 3, 0]]], dtype=float)
    data = stl_of(corners)
    assert len(data) == 84 + 50
    numbers = np.frombuffer(data[84:132], "<f4").reshape(4, 3)
    assert numbers[0].tolist() == [0, 0, 1]
    assert np.array_equal(numbers[1:], corners[0])
    assert len(stl_of(np.zeros((0, 3, 3)))) == 84
