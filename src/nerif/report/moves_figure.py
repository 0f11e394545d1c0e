"""How far a refinement moved the cameras of a rig: in their standard deviations, and where to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nerif.geometry import Camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_moved_rig", "draw_moves"]

SHOWN_AS = 0.25  # of the reach of the rig: the longest shift as drawn


def draw_moves(axes: Axes, table: Sequence[dict[str, Any]]) -> Axes:
    """Draw each refined number of each view, in its standard deviation beforehand; bars are those afterwards."""
    names = list(table[0]["values"])
    for i, row in enumerate(table):
        held = [row["sigma"][name] for name in names]
        known = [n for n, sigma in enumerate(held) if sigma > 0]
        at = [row["values"][names[n]] / held[n] for n in known]
        after = [row.get("sigma_after", {}).get(names[n], 0.0) / held[n] for n in known]
        place = np.array(known) + 0.7 * ((i + 0.5) / len(table) - 0.5)
        axes.errorbar(place, at, yerr=after, fmt="o", ms=3, lw=0.8, label=row["name"])
    for limit in (-3, 3):
        axes.axhline(limit, color="0.6", lw=0.8, ls="--")
    axes.axhline(0, color="0.6", lw=0.8)
    axes.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=7)
    axes.set_ylabel("moved by [standard deviations]")
    axes.legend(fontsize=6, ncols=max(1, len(table) // 3))
    return axes


def draw_moved_rig(axes: Axes, cameras: Sequence[Camera], table: Sequence[dict[str, Any]]) -> Axes:
    """Draw the rig from above with both poses: circles as calibrated, arrows to where cameras stand, enlarged.

    Parameters
    ----------
    cameras : as refined
    table : of the refinement, of these cameras
    """
    rows = {row["name"]: row["values"] for row in table}
    centres = np.stack([camera.centre.double().numpy() for camera in cameras])
    shifts, looks = np.zeros_like(centres), np.stack([camera.rotation[2].double().numpy() for camera in cameras])
    for i, camera in enumerate(cameras):
        own = np.array([rows.get(camera.name, {}).get(f"shift_{axis}", 0.0) for axis in "xyz"])
        shifts[i] = camera.rotation.double().numpy().T @ own
    reach = float(np.abs(centres - centres.mean(axis=0)).max()) or 1.0
    longest = float(np.linalg.norm(shifts, axis=1).max())
    enlarged = SHOWN_AS * reach / longest if longest > 0 else 1.0
    before = centres - shifts
    for i, camera in enumerate(cameras):
        axes.plot(*before[i, :2], "o", mfc="none", color=f"C{i % 10}", ms=6)
        axes.plot(*np.stack([before[i], before[i] + 0.3 * reach * looks[i]])[:, :2].T, color=f"C{i % 10}", lw=0.6)
        end = before[i] + enlarged * shifts[i]
        axes.annotate("", end[:2], before[i, :2], arrowprops={"arrowstyle": "->", "color": f"C{i % 10}"})
        axes.annotate(camera.name, before[i, :2], xytext=(4, 4), textcoords="offset points", fontsize=6)
    axes.margins(0.2)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("y [mm]")
    axes.set_title(f"shifts {enlarged:.2g} times as long; longest {longest:.2g} mm", fontsize=8)
    return axes
