"""Masks drawn by polygons and brushes."""

from __future__ import annotations

import numpy as np
import pytest

from nerif.common.conventions import InputError
from nerif.imaging.masks import MaskShape, drawn_masks, mask_of, write_masks
from nerif.imaging.readers.open import read_mask
from refusals import refused

SQUARE = MaskShape("polygon", ((4, 2), (11, 2), (11, 8), (4, 8)))


def test_shapes_lie_over_one_another():
    mask = mask_of([SQUARE, MaskShape("brush", ((0, 5), (19, 5)), False, 3.0)], (12, 20))
    rows, columns = np.indices(mask.shape)
    inside = (rows >= 2) & (rows <= 8) & (columns >= 4) & (columns <= 11)
    assert np.array_equal(mask, inside & (abs(rows - 5) > 1))
    dot = mask_of([MaskShape("brush", ((10, 6),), True, 5.0)], (12, 20))
    assert 15 < dot.sum() < 26
    assert dot[6, 10]


def test_images_are_read_as_they_were_drawn(tmp_path):
    write_masks(tmp_path / "masks", {"a": [SQUARE], "b": []}, {"a": (12, 20), "b": (12, 20)})
    (path,) = drawn_masks(tmp_path / "masks", ["a", "b"]).values()
    assert np.array_equal(read_mask(path, (12, 20)), mask_of([SQUARE], (12, 20)))


@pytest.mark.parametrize("drawn", [[], [MaskShape("brush", ((0, 0), (19, 11)), True, 80.0)]], ids=["erased", "all"])
def test_nothing_and_everything_are_refused(tmp_path, drawn):
    erased = [SQUARE, MaskShape("polygon", SQUARE.points, False)]
    with refused("mask of view 'a'"):
        write_masks(tmp_path, {"a": drawn or erased}, {"a": (12, 20)})


@pytest.mark.parametrize("name", ["../../outside", "/tmp/outside", "a/b", "a\\b", "..", ""])
def test_a_view_whose_name_leads_elsewhere_is_refused_before_anything_is_written(tmp_path, name):
    folder = tmp_path / "project" / "masks"
    with refused("view"):
        write_masks(folder, {"a": [SQUARE], name: [SQUARE]}, {"a": (12, 20), name: (12, 20)})
    assert list(tmp_path.rglob("*")) == []


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("oval", ((0, 0),)), "kind"),
        (("polygon", ((0, 0), (1, 1))), "points"),
        (("brush", ((float("nan"), 0),)), "points"),
        (("brush", ((0, 0),), True, 0.0), "width"),
    ],
)
def test_what_is_no_shape_is_refused(arguments, named):
    with pytest.raises(InputError, match=named):
        MaskShape(*arguments)
