"""The scene of a page, which its scripts draw: grids, quantities and colours as JSON, and packed arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from nerif.common.conventions import unit_shown
from nerif.data.quantity_names import INDEX, name_of
from nerif.data.volume import Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.geometry import Grid
from nerif.physics.gas import GasSettings
from nerif.physics.media import stored_medium
from nerif.physics.medium import Medium, derive
from nerif.plotting.drawing import (
    DIVERGING,
    LABELS,
    colour_range,
    colours_of,
    plotted_quantities,
    plotted_values,
)
from nerif.report import packing
from nerif.report.isosurface import default_level
from nerif.report.journal_figures import error_of
from nerif.report.rig_figure import image_corners
from nerif.report.view_images import colour_table
from nerif.results.directory import Result

__all__ = ["scene_of", "scene_over_time"]

MAX_TRIANGLES, BODY_CELLS = 20_000, 100  # of a body as it is; of the lattice along its longest edge
MAX_FRAME_VOXELS = 48  # along the longest edge; the page of a sequence has dozens of volumes


def scene_of(result: Result) -> tuple[dict[str, Any] | None, dict[str, str]]:
    """Return the scene of a result, and its packed arrays by name."""
    field, quantities = result.field, plotted_quantities(result.volumes)
    if field is None or (field.quantity == INDEX and field.n_ambient is None) or not quantities:
        return None, {}
    small = packing.coarsen(field)
    sources: dict[str, Volume] = {"value": small}
    error = error_of(result)
    if error is not None:
        sources["error"] = packing.coarsen(error)
    if f"{field.quantity}_std" in result.volumes:
        sources["std"] = packing.coarsen(result.volumes[f"{field.quantity}_std"])
    ends = (float(small.values.nan_to_num().min()), float(small.values.nan_to_num().max()))
    medium = stored_medium(result.settings)
    entries = {q: _quantity(q, result.volumes[q], default_level(result.volumes[q]), medium, ends) for q in quantities}
    for quantity in quantities:
        std = result.volumes.get(f"{quantity}_std")
        # others are a linear function of that of the excess
        linear = entries[quantity]["relation"]["kind"] == "linear"
        if std is not None and not (linear and bool(torch.isfinite(std.values).all())):
            sources[std.quantity] = packing.coarsen(std)
    packed = {
        name: packing.pack(volume.values.double().numpy(), packing.FINE if name == "value" else packing.COARSE)
        for name, volume in sources.items()
    }
    variants = {"value": "Reconstruction"}
    if "std" in sources:
        variants["std"] = "Standard deviation"
    if "error" in sources:
        variants |= {"truth": "Truth", "error": "Error"}
    scene = {
        **_scene(small.grid, field.grid, entries, variants, (DIVERGING, "cividis")),
        "arrays": {name: {"low": p["low"], "step": p["step"]} for name, p in packed.items()},
        "cameras": _cameras(result),
        "bodies": _bodies(result),
        "backgrounds": result.measurement is not None and any(c.background for c in result.measurement.cameras),
    }
    return scene, {name: p["text"] for name, p in packed.items()}


def scene_over_time(store: VolumeSequence, frames: list[int], field: str) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the scene of a quantity in some frames of a sequence, and the packed volumes by name."""
    small = [packing.coarsen(store.volume(i, field), MAX_FRAME_VOXELS) for i in frames]
    packed = [packing.pack(v.values.double().numpy(), packing.COARSE) for v in small]
    medium = stored_medium(store.attributes)
    quantities = {}
    some = small[:: max(1, len(small) // 8)]
    absent = {name for v in some for name in medium.absent(v)} if medium is not None else {*GasSettings.names}
    medium_of_page = medium or GasSettings()
    extremes = (
        min(float(v.values.nan_to_num().min()) for v in small),
        max(float(v.values.nan_to_num().max()) for v in small),
    )
    for name in plotted_quantities([q for q in medium_of_page.available(field) if q not in absent]):
        sample = [derive(v, name, medium_of_page) for v in some]
        ends = [colour_range(plotted_values(v)) for v in sample]
        quantities[name] = {
            **_quantity(name, sample[0], float(np.median([default_level(v) for v in sample])), medium, extremes),
            "range": [min(e[0] for e in ends), max(e[1] for e in ends)],
        }
    scales = [{"low": p["low"], "step": p["step"]} for p in packed]
    scene = {
        **_scene(small[0].grid, store.grid, quantities, {"value": "Reconstruction"}),
        "arrays": {"value": scales[0]},
        "frames": [{"index": i, "time": store.times[i], **s} for i, s in zip(frames, scales, strict=True)],
        "cameras": [],
        "bodies": [],
    }
    arrays = {"value": packed[0]["text"]}
    return scene, arrays | {f"frame-{k}": p["text"] for k, p in enumerate(packed)}


def _quantity(
    name: str, volume: Volume, level: float, medium: Medium | None, ends: tuple[float, float]
) -> dict[str, Any]:  # fmt: skip
    """Labels and colours of a quantity, its relation to the field between two ends, and the level of its isosurface."""
    if medium is None or isinstance(medium, GasSettings) or name not in medium.names:
        relation = packing.relation(name, volume.attributes)
    else:
        relation = packing.tabulated(name, medium, float(volume.attributes["n_ambient"]), *ends)
    label, unit = LABELS.get(name, (name, volume.unit))
    return {
        "button": name_of(name).capitalize(),
        "label": label,
        "unit": unit_shown(unit),
        "relation": relation,
        "colours": colours_of(name),
        "level": level,
    }


def _scene(
    small: Grid, full: Grid, quantities: dict[str, dict[str, Any]], variants: dict[str, str], more: Sequence[str] = ()
) -> dict[str, Any]:
    """What all scenes have; `more` are colour maps beside those of the quantities."""
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


def _bodies(result: Result) -> list[dict[str, Any]]:
    """The triangles of bodies, mm, with vertices of a lattice where there are many."""
    bodies = []
    for body in () if result.measurement is None else result.measurement.bodies:
        vertices, faces = body.vertices.numpy(), body.faces.numpy()
        if len(faces) > MAX_TRIANGLES:
            lower, upper = vertices.min(axis=0), vertices.max(axis=0)
            cell = float((upper - lower).max()) / BODY_CELLS
            vertices, index = np.unique(np.round((vertices - lower) / cell) * cell + lower, axis=0, return_inverse=True)
            faces = index.ravel()[faces]
            a, b, c = faces.T
            faces = np.unique(faces[(a != b) & (b != c) & (c != a)], axis=0)
        bodies.append({"vertices": np.round(vertices, 3).ravel().tolist(), "faces": faces.ravel().tolist()})
    return bodies


def _cameras(result: Result) -> list[dict[str, Any]]:
    """The lines of sight of the image corners of every camera, mm."""
    if result.measurement is None:
        return []
    withheld = () if result.reprojection is None else result.reprojection.withheld
    centre = np.array(result.measurement.box.centre)
    cameras = []
    for camera in result.measurement.cameras:
        corners = image_corners(camera, centre)
        cameras.append(
            {
                "name": camera.name,
                "withheld": camera.name in withheld,
                "background": camera.background is not None,
                "starts": np.round(corners.start, 3).tolist(),
                "directions": np.round(corners.direction, 6).tolist(),
                "ends": np.round(corners.end, 3).tolist(),
            }
        )
    return cameras
