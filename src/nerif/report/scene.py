"""What the pages draw their own images from: grids, quantities and colours as JSON, and packed arrays beside it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from nerif.common.conventions import unit_shown
from nerif.data.volume import INDEX, Volume, field_of, name_of, quantities_of
from nerif.data.volume_sequence import VolumeSequence
from nerif.geometry import Grid
from nerif.physics.quantities import GasSettings, derive
from nerif.plotting.drawing import COLOUR_MAPS, DIVERGING, LABELS, SEQUENTIAL, colour_range, drawn_of, shown
from nerif.report import packing
from nerif.report.isosurface import default_level
from nerif.report.pages import error_of
from nerif.report.rig_figure import image_corners
from nerif.report.view_images import colour_table
from nerif.results.directory import Result

__all__ = ["scene_of", "scene_over_time"]

LARGEST = 48  # voxels of a sequence along the longest edge: its page holds dozens of volumes


def scene_of(result: Result) -> tuple[dict[str, Any] | None, dict[str, str]]:
    """Return what the page of a result draws from: grid, quantities, cameras; and the packed arrays by name."""
    whole = result.field
    if whole is None or (whole.quantity == INDEX and whole.n_ambient is None):
        return None, {}
    small = packing.coarsen(whole)
    sources: dict[str, Volume] = {"value": small}
    error = error_of(result)
    if error is not None:
        sources["error"] = packing.coarsen(error)
    if f"{whole.quantity}_std" in result.volumes:
        sources["std"] = packing.coarsen(result.volumes[f"{whole.quantity}_std"])
    for quantity in ("density", "temperature"):
        volume = result.volumes.get(f"{quantity}_std")
        if volume is not None and _own(quantity, volume):
            sources[volume.quantity] = packing.coarsen(volume)
    packed = {
        name: packing.pack(volume.values.double().numpy(), packing.FINE if name == "value" else packing.COARSE)
        for name, volume in sources.items()
    }
    quantities = {
        name: _quantity(name, result.volumes[name], default_level(result.volumes[name]))
        for name in drawn_of(result.volumes)
    }
    if not quantities:
        return None, {}
    scene = {
        **_scene(small.grid, whole.grid, quantities, _variants(sources), (DIVERGING, "cividis")),
        "arrays": {name: {"low": p["low"], "step": p["step"]} for name, p in packed.items()},
        "cameras": _cameras(result),
        "backgrounds": result.measurement is not None and any(c.background for c in result.measurement.cameras),
    }
    return scene, {name: p["text"] for name, p in packed.items()}


def scene_over_time(store: VolumeSequence, chosen: list[int]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return what the page of a sequence draws from, of the frames chosen; and the packed volumes by name."""
    field = field_of(store.quantities)
    assert field is not None, "there is a field to show"
    small = [packing.coarsen(store.volume(i, field), LARGEST) for i in chosen]
    packed = [packing.pack(v.values.double().numpy(), packing.COARSE) for v in small]
    gas = GasSettings(**store.attributes["gas"]) if "gas" in store.attributes else None
    quantities = {}
    follows = drawn_of(quantities_of(field))
    for name in follows if gas is not None else follows[:1]:
        some = [derive(v, name, gas or GasSettings()) for v in small[:: max(1, len(small) // 8)]]
        ends = [colour_range(shown(v)) for v in some]
        quantities[name] = {
            **_quantity(name, some[0], float(np.median([default_level(v) for v in some]))),
            "range": [min(e[0] for e in ends), max(e[1] for e in ends)],
        }
    scales = [{"low": p["low"], "step": p["step"]} for p in packed]
    scene = {
        **_scene(small[0].grid, store.grid, quantities, {"value": "Reconstruction"}),
        "arrays": {"value": scales[0]},
        "frames": [{"index": i, "time": store.times[i], **s} for i, s in zip(chosen, scales, strict=True)],
        "cameras": [],
    }
    arrays = {"value": packed[0]["text"]}
    return scene, arrays | {f"frame-{k}": p["text"] for k, p in enumerate(packed)}


def _quantity(name: str, volume: Volume, level: float) -> dict[str, Any]:
    """How a quantity is called and coloured, and follows from the reconstructed field; `level` of its isosurface."""
    label, unit = LABELS.get(name, (name, volume.unit))
    return {
        "button": name_of(name).capitalize(),
        "label": label,
        "unit": unit_shown(unit),
        "relation": packing.relation(name, volume.attributes),
        "colours": COLOUR_MAPS.get(name, SEQUENTIAL),
        "level": level,
    }


def _scene(
    small: Grid, full: Grid, quantities: dict[str, dict[str, Any]], variants: dict[str, str], more: Sequence[str] = ()
) -> dict[str, Any]:
    """What every scene has: grids, quantities, what can be switched to, and colours, `more` beside the quantities'."""
    maps = sorted({q["colours"] for q in quantities.values()} | {*more})
    return {
        "shape": small.shape,
        "full_shape": full.shape,
        "lower": full.box.lower,
        "upper": full.box.upper,
        "quantities": quantities,
        "variants": variants,
        "diverging": DIVERGING if DIVERGING in maps else "",
        "tables": {name: [c for rgb in colour_table(name) for c in rgb] for name in maps},
    }


def _own(quantity: str, volume: Volume) -> bool:
    """Whether a statistic has to be packed for itself: it is no linear function of the excess, or masked somewhere."""
    return quantity == "temperature" or not bool(torch.isfinite(volume.values).all())


def _variants(sources: dict[str, Volume]) -> dict[str, str]:
    """What can be switched to, and its button."""
    found = {"value": "Reconstruction"}
    if "std" in sources:
        found["std"] = "Standard deviation"
    if "error" in sources:
        found |= {"truth": "Truth", "error": "Error"}
    return found


def _cameras(result: Result) -> list[dict[str, Any]]:
    """The lines to the corners of the image, from where to draw them to the background, of every camera; mm."""
    if result.measurement is None:
        return []
    withheld = () if result.reprojection is None else result.reprojection.withheld
    found = []
    middle = np.array(result.measurement.box.centre)
    for camera in result.measurement.cameras:
        corners = image_corners(camera, middle)
        found.append(
            {
                "name": camera.name,
                "withheld": camera.name in withheld,
                "background": camera.background is not None,
                "starts": np.round(corners.start, 3).tolist(),
                "directions": np.round(corners.direction, 6).tolist(),
                "ends": np.round(corners.end, 3).tolist(),
            }
        )
    return found
