"""What is wrong with a measurement as a whole: rims that are not at rest, and flow that goes on beyond the box."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.analysis.prediction import predict_view
from nerif.common.conventions import FACES
from nerif.common.findings import Finding
from nerif.data.measurement import Measurement
from nerif.fields.base import Field
from nerif.forward.base import ForwardModel
from nerif.quick_views import path_integral, values_of
from nerif.reconstruction.gauge import ambient_faces

__all__ = ["looks", "open_faces"]

OPEN = (0.4, 2.0)  # flow goes on beyond a face: what is not explained of rays through it is at least this share of what
# the others measured, and this many times theirs as a share of its own. Rays through an end cross a corner of the box
# and carry little: flow that ends at the box leaves a large share of that unexplained, but of a small thing
FEWEST = 20  # rays of which something can be said


def open_faces(field: Field, small: Measurement) -> list[Finding]:
    """Return a finding for each face beyond which the flow seems to go on: rays through it fit worse than others.

    The others are those through faces known to be ambient alone. Where no face is, they are those not through this one
    nor through one that was found; the worst face comes first.
    """
    what, known = small.observations[0].technique.measured, ambient_faces(small)
    squares, through = _through_faces(field, small)
    suspects = [face for face in FACES if face not in known]
    ambient, left = torch.ones(len(squares), dtype=torch.bool), torch.ones(len(squares), dtype=torch.bool)
    for face in suspects:
        ambient &= ~through[face]
    found = {}
    for face in sorted(suspects, key=lambda face: -_unexplained(squares[through[face]])):
        own, usual = squares[through[face] & left], squares[ambient if known else ~through[face] & left]
        if len(own) < FEWEST or len(usual) < FEWEST:
            continue
        share, share_usual = _unexplained(own), _unexplained(usual)
        size = float((own[:, 0].mean() / (usual if known else squares[left])[:, 1].mean()).sqrt())
        if size > OPEN[0] and share > OPEN[1] * share_usual:
            left &= ~through[face]
            found[face] = Finding(
                "open_face",
                f"face {face}: {share:.0%} of the {what} of rays through it is not explained, {share_usual:.0%} of "
                f"the others; the flow seems to go on beyond it: give --open-faces {face}, or a larger box",
            )
    return [found[face] for face in suspects if face in found]


def _through_faces(field: Field, small: Measurement) -> tuple[Float[Tensor, "n 2"], dict[str, Bool[Tensor, " n"]]]:
    """Of every ray that measured something the squares of what is not explained, and of it all; and its faces."""
    model, channels = path_integral(small), values_of(small).shape[-1]
    squares: list[Tensor] = []
    through: dict[str, list[Tensor]] = {face: [] for face in FACES}
    for i, camera in enumerate(small.cameras):
        height, width = camera.image_size
        predicted = predict_view(field, camera, model, small.box).reshape(-1, channels)
        measured = values_of(small)[i, :height, :width].reshape(-1, channels)
        rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(small.box)
        good = torch.isfinite(measured).all(dim=-1) & rays.crosses
        both = torch.stack([(predicted - measured).square().sum(dim=-1), measured.square().sum(dim=-1)], dim=-1)
        squares.append(both[good])
        for face in FACES:
            through[face].append(rays.exit_faces(small.box, [face])[good])
    return torch.cat(squares), {face: torch.cat(masks) for face, masks in through.items()}


def _unexplained(squares: Float[Tensor, "n 2"]) -> float:
    """The share of what rays measured that is not explained, 0 where they measured nothing."""
    lost, all_of_it = squares.sum(dim=0).tolist()
    return math.sqrt(lost / all_of_it) if all_of_it > 0 else 0.0


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
