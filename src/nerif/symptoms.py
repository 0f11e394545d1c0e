"""What is wrong with a measurement as a whole: rims that are not at rest, and flow that goes on beyond the box."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from nerif.conventions import FACES
from nerif.fields.base import Field
from nerif.measurement import Measurement
from nerif.prediction import predict_view
from nerif.quick_views import path_integral, values_of
from nerif.techniques.base import ForwardModel

__all__ = ["looks", "open_faces"]

OPEN = (0.4, 2.0)  # flow goes on beyond a face: what is not explained of rays through it is at least this share of what
# the others measured, and this many times theirs as a share of its own. Rays through an end cross a corner of the box
# and carry little: flow that ends at the box leaves a large share of that unexplained, but of a small thing


def open_faces(field: Field, small: Measurement) -> list[str]:
    """Return a finding for each face beyond which the flow seems to go on: rays through it fit worse than others."""
    model, channels = path_integral(small), values_of(small).shape[-1]
    what = small.observations[0].technique.measured
    groups: dict[str, list[Tensor]] = {face: [] for face in (*FACES, "none")}
    suspects = [face for face in FACES if face not in small.ambient_faces]
    for i, camera in enumerate(small.cameras):
        height, width = camera.image_size
        predicted = predict_view(field, camera, model, small.box).reshape(-1, channels)
        measured = values_of(small)[i, :height, :width].reshape(-1, channels)
        rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(small.box)
        good = torch.isfinite(measured).all(dim=-1) & rays.crosses
        both = torch.stack([(predicted - measured).square().sum(dim=-1), measured.square().sum(dim=-1)], dim=-1)
        through = {face: rays.exit_faces(small.box, [face]) & good for face in suspects}
        rest = good.clone()
        for face, mask in through.items():
            groups[face].append(both[mask])
            rest &= ~mask
        groups["none"].append(both[rest])
    findings, usual = [], torch.cat(groups["none"])
    for face in suspects:
        own = torch.cat(groups[face])
        if len(own) < 20 or len(usual) < 20:
            continue
        left, left_usual = (float((g[:, 0].sum() / g[:, 1].sum()).sqrt()) for g in (own, usual))
        unexplained = float((own[:, 0].mean() / usual[:, 1].mean()).sqrt())
        if unexplained > OPEN[0] and left > OPEN[1] * left_usual:
            findings.append(
                f"face {face}: {left:.0%} of the {what} of rays through it is not explained, {left_usual:.0%} of "
                f"the others; the flow seems to go on beyond it: give --open-faces {face}, or a larger box"
            )
    return findings


def looks(measurement: Measurement, small: Measurement, valid: Sequence[float]) -> list[str]:
    """Return what the maps themselves tell."""
    remarks, kind = [], measurement.observations[0].technique
    for i, name in enumerate(measurement.names):
        if valid[i] < 0.5:
            remarks.append(f"view {name}: only {valid[i]:.0%} of its pixels can be used")
        rows, columns = small.cameras[i].image_size
        d = values_of(small)[i, :rows, :columns]
        rim = torch.ones(rows, columns, dtype=torch.bool)
        edge = max(1, min(rows, columns) // 12)
        down = slice(edge, -edge) if rows > 2 * edge else slice(None)  # a line has two ends and no rim
        rim[down, edge:-edge] = False
        rim &= torch.isfinite(d).all(dim=-1)
        inner = d[torch.isfinite(d).all(dim=-1)]
        if int(rim.sum()) < 20:
            continue
        offset, spread = d[rim].median(dim=0).values, d[rim].std(dim=0)
        rms = inner.square().mean().sqrt()
        if float(offset.norm()) > 0.5 * float(rms) and bool((offset.abs() > 2 * spread).any()):
            remarks.append(f"view {name}: {_of_rim(kind, offset, measurement.cameras[i].image_size[1] / columns)}")
    return remarks


def _of_rim(kind: type[ForwardModel], offset: Tensor, shrunk: float) -> str:
    """What a rim says that is not at rest, in pictures that were shrunk."""
    if kind.background:
        u, v = (float(x) * shrunk for x in offset)
        moved = f"its rim is displaced by ({u:.2f}, {v:.2f}) px as a whole; did the camera move?"
        return f"{moved} nerif displacement --shake-border removes it"
    value = f"its rim shows {kind.measured} {float(offset[0]):.3g} as a whole"
    return f"{value}; if nothing but the ambient is there, subtract it as the offset of the background"
