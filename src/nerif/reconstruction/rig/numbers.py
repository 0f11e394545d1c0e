"""The numbers that are refined of a rig: their names and units, and by what they are held beforehand."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.geometry import Camera
from nerif.geometry.pose import GEOMETRY

__all__ = ["IMAGE", "NAMES", "REFINED", "UNITS", "check_refined", "displaced", "prior", "refined_words"]

IMAGE = ("u", "v", "u_x", "u_y", "v_x", "v_y")
"""Displacement of a whole image, px: constant, and growing from the middle to the edge along columns and rows."""
NAMES = (*GEOMETRY, *IMAGE)
UNITS = (*("rad",) * 3, *("mm",) * 3, "1", "mm", *("px",) * 6)
REFINED = {"cameras": range(6), "focal": range(6, 7), "background": range(7, 8), "shift": range(8, 14)}
"""What can be refined, and which of NAMES it is."""


POSE_SIGMA = 0.2, 0.02  # mm, degrees
ZOOM_SIGMA, BACKGROUND_SIGMA = 1e-3, 0.5  # of a focal length, as a share; mm
LINEAR = 0.2  # of the shift: what turn and zoom of a shaken camera move its edge by


def refined_words(refine: Sequence[str]) -> tuple[str, ...]:
    """Return the words of a setting, which may stand one by one or with commas between."""
    return tuple(dict.fromkeys(word for given in refine for word in given.replace(",", " ").split()))


def check_refined(refine: Sequence[str], mm: float | None, deg: float | None, px: float) -> None:
    """Refuse what cannot be refined, and standard deviations that are none.

    Raises
    ------
    InputError
        Naming it.
    """
    for word in refined_words(refine):
        if word not in REFINED:
            raise InputError(f"expected some of {', '.join(REFINED)}, got '{word}'", field="refine")
    for name, value in (("pose_sigma_mm", mm), ("pose_sigma_deg", deg), ("shift_sigma_px", px)):
        if value is not None and not 0 < value < 1e6:
            raise InputError(f"expected a standard deviation above 0, got {value}", field=name)


def displaced(numbers: Float[Tensor, "n 6"], place: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
    """Return the displacement of a whole image, px, from its middle (IMAGE): at places, 1 at the edge."""
    return numbers[:, :2] + torch.einsum("nij,nj->ni", numbers[:, 2:].unflatten(1, (2, 2)), place)


def prior(camera: Camera, mm: float | None, deg: float | None, px: float) -> Float[Tensor, 14]:
    """Return the standard deviations of NAMES of a view.

    Parameters
    ----------
    mm, deg : of where it stands and how it is turned; None for what it knows of itself, or POSE_SIGMA
    px : of the shift of its image
    """
    rest = torch.tensor([ZOOM_SIGMA, BACKGROUND_SIGMA, px, px, *[LINEAR * px] * 4], dtype=torch.float64)
    return torch.cat([_pose_sigma(camera, mm, deg), rest])


def _pose_sigma(camera: Camera, mm: float | None, deg: float | None) -> Float[Tensor, 6]:
    """What is given, else what the camera knows, else POSE_SIGMA."""
    shift, turn = POSE_SIGMA
    sigma = torch.tensor([math.radians(turn)] * 3 + [shift] * 3, dtype=torch.float64)
    if camera.pose_sigma is not None:
        sigma = camera.pose_sigma.double().clone()
    if deg is not None:
        sigma[:3] = math.radians(deg)
    if mm is not None:
        sigma[3:] = mm
    return sigma
