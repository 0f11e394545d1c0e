"""Groups of parameters of a rig that can be refined, as settings name them."""

from __future__ import annotations

from collections.abc import Sequence

from nerif.common.conventions import InputError

__all__ = ["GROUPS", "check_refined", "refined_groups"]

GROUPS = {"cameras": range(6), "focal": range(6, 7), "background": range(7, 8), "shift": range(8, 14)}
"""Groups of parameters that can be refined, as indices of rig_parameters.NAMES."""


def refined_groups(refine: Sequence[str]) -> tuple[str, ...]:
    """Return the groups of a setting, whose items may contain several, separated by commas."""
    return tuple(dict.fromkeys(group for item in refine for group in item.replace(",", " ").split()))


def check_refined(refine: Sequence[str], mm: float | None, deg: float | None, px: float) -> None:
    """Refuse unknown groups and invalid standard deviations."""
    for group in refined_groups(refine):
        if group not in GROUPS:
            raise InputError(f"expected some of {', '.join(GROUPS)}, got '{group}'", field="refine")
    for name, value in (("pose_sigma_mm", mm), ("pose_sigma_deg", deg), ("shift_sigma_px", px)):
        if value is not None and not 0 < value < 1e6:
            raise InputError(f"expected a standard deviation above 0, got {value}", field=name)
