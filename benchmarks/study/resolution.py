"""Spatial resolution by the octahedron phantom, over all faces and place by place (paper, App. D).

The gradient of the phantom has a step at its eight faces. With N the outward normal of a face, t the distance from it
along N and g the true step sqrt(3) amplitude / unit,

    ESF(t) = N . grad n(t) / g

and the resolution is that of its modulation transfer function (benchmarks.study.mtf). The profiles:

- All have one half length L, so that places can be compared. They stand on the part of a face where they end a margin
  (0.05 units) before the planes x, y, z = 0, beyond which the gradient steps again: |x|, |y|, |z| >= L / sqrt(3) +
  margin. From there their outer end always lies within the box. L = 0.4 units leaves 44 % of every edge, 19 % of a
  face; the window alone then has 1.5 lp/unit.
- Where the whole phantom is blurred, the steps beyond the ends come in as well: 2 % at sigma = L / 4, 5 % (single
  patches 8 %) at L / 3.
- Profiles are averaged over a patch, or over all faces, before they are differentiated; the scatter of neighbouring
  patches shows how much noise remains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.study.mtf import COARSEST, MTF
from nerif.common.conventions import InputError
from nerif.fields.field import Field, in_chunks
from nerif.fields.phantoms import Octahedron
from nerif.geometry import Camera

SIZE = 1.5  # units from the centre of the octahedron to its corners
MARGIN = 0.05  # units


@dataclass(frozen=True)
class Resolution:
    """Spatial resolution of a reconstructed octahedron; NaN and 0 as in `MTF.resolution`.

    Parameters
    ----------
    unit : mm; a quarter of the shortest edge of the box
    half_length : L of the profiles, mm
    distance : (t,) from the face, outward, mm
    edge_spread : (t,) ESF averaged over all faces, 1; the truth is -1 inside and 0 outside
    mtf : of it, frequencies in lp/mm
    patches : (k, 3, 3) corners of the triangles of the faces, mm
    local_lp_per_mm : (k,) of the profiles averaged over each triangle, lp/mm
    """

    unit: float
    half_length: float
    distance: Float[Tensor, " t"]
    edge_spread: Float[Tensor, " t"]
    mtf: MTF
    patches: Float[Tensor, "k 3 3"]
    local_lp_per_mm: Float[Tensor, " k"]

    @property
    def lp_per_mm(self) -> float:
        """Of the profile averaged over all faces."""
        return float(self.mtf.resolution)

    @property
    def lp_per_unit(self) -> float:
        return self.lp_per_mm * self.unit

    @property
    def mtf_per_unit(self) -> MTF:
        """The MTF over lp/unit."""
        return MTF(self.mtf.frequency * self.unit, self.mtf.transfer)

    @property
    def local_lp_per_unit(self) -> Float[Tensor, " k"]:
        return self.local_lp_per_mm * self.unit

    @property
    def coarsest(self) -> float:
        """Resolution of the window alone, a lower bound, lp/unit."""
        return COARSEST / self.half_length * self.unit

    @property
    def positions(self) -> Float[Tensor, "k 3"]:
        """Middles of the patches, mm."""
        return self.patches.mean(dim=1)

    @property
    def normals(self) -> Float[Tensor, "k 3"]:
        """Outward normals of the patches."""
        return (self.positions - self.patches.mean(dim=(0, 1))).sign() / math.sqrt(3)


@torch.no_grad()
def measure_resolution(
    field: Field, phantom: Octahedron, half_length: float = 0.4, patches: int = 4, points: int = 4,
    samples: int = 256, device: torch.device | str = "cpu",
) -> Resolution:  # fmt: skip
    """Measure the spatial resolution of a reconstruction of the octahedron.

    Parameters
    ----------
    half_length : L, units
    patches : every face is split into patches^2 triangles of equal size
    points : every such triangle has points^2 profiles, evenly spread
    samples : per unit, along a profile; their Nyquist frequency is samples / 2 lp/unit
    """
    longest = math.sqrt(3) * (SIZE / 3 - MARGIN)
    if not 0 < half_length < longest:
        raise InputError(f"expected 0 to {longest:.2f} units, got {half_length}", field="half_length")
    if min(patches, points) < 1 or samples * half_length < 4:
        counts = f"{patches}, {points} and {samples * half_length:g}"
        raise InputError(
            f"expected patches and points >= 1 and 4 samples in half_length, got {counts}", field="samples"
        )
    unit = phantom.unit
    triangles = _split(_inner_faces(phantom, half_length), patches)
    places = _split(triangles, points).mean(dim=1)
    normals = (places - places.new_tensor(phantom.box.centre)).sign() / math.sqrt(3)
    count = round(samples * half_length)
    # half a sample off the face, so that rounding does not decide the side of the step
    distance = (torch.arange(-count, count, dtype=torch.float64) + 0.5) * (unit / samples)

    true_step = math.sqrt(3) * phantom.amplitude / unit
    spread = torch.empty(len(places), len(distance), dtype=torch.float64)
    for rows in in_chunks(torch.arange(len(places)), max(1, (1 << 13) // len(distance))):
        line = places[rows, None] + distance[:, None] * normals[rows, None]
        gradient = field.gradient(line.reshape(-1, 3).to(device, torch.float32)).cpu().double()
        spread[rows] = (gradient.reshape(line.shape) * normals[rows, None]).sum(-1) / true_step
    local = spread.reshape(len(triangles), -1, len(distance)).mean(dim=1)
    overall = local.mean(dim=0)

    return Resolution(
        unit=unit,
        half_length=half_length * unit,
        distance=distance,
        edge_spread=overall,
        mtf=MTF.of(overall, unit / samples),
        patches=triangles,
        local_lp_per_mm=MTF.of(local, unit / samples).resolution,
    )


def _inner_faces(phantom: Octahedron, half_length: float) -> Float[Tensor, "8 3 3"]:
    """Corners (mm) of the part of each face where profiles of that half length (units) fit."""
    least = half_length / math.sqrt(3) + MARGIN
    corners = torch.full((3, 3), least, dtype=torch.float64)
    corners.fill_diagonal_(SIZE - 2 * least)
    signs = torch.tensor(list(product((1.0, -1.0), repeat=3)), dtype=torch.float64)
    return signs[:, None] * corners * phantom.unit + corners.new_tensor(phantom.box.centre)


def _split(triangles: Float[Tensor, "k 3 3"], n: int) -> Float[Tensor, "m 3 3"]:
    """Split every triangle into n^2 equal ones, which follow each other."""
    whole = [(i, j) for i in range(n) for j in range(n - i)]
    upright = [[(i, j), (i + 1, j), (i, j + 1)] for i, j in whole]
    turned = [[(i + 1, j + 1), (i, j + 1), (i + 1, j)] for i, j in whole if i + j < n - 1]
    along = torch.tensor(upright + turned, dtype=triangles.dtype) / n
    weights = torch.cat([1 - along.sum(-1, keepdim=True), along], dim=-1)  # of the three corners
    return torch.einsum("pcb,kbx->kpcx", weights, triangles).reshape(-1, 3, 3)


def to_plain(resolution: Resolution) -> dict[str, Any]:
    """Return a Resolution as numbers and lists for JSON."""
    return {
        "lp_per_mm": resolution.lp_per_mm,
        "lp_per_unit": resolution.lp_per_unit,
        "coarsest_lp_per_unit": resolution.coarsest,
        "finest_lp_per_unit": float(resolution.mtf_per_unit.frequency[-1]),
        "unit_mm": resolution.unit,
        "half_length_mm": resolution.half_length,
        "distance_mm": resolution.distance.tolist(),
        "edge_spread": resolution.edge_spread.tolist(),
        "frequency_lp_per_mm": resolution.mtf.frequency.tolist(),
        "mtf": resolution.mtf.transfer.tolist(),
        "patches_mm": resolution.patches.tolist(),
        "local_lp_per_mm": resolution.local_lp_per_mm.tolist(),
    }


def from_plain(plain: dict[str, Any]) -> Resolution:
    """Return the Resolution of `to_plain`; None is NaN."""

    def numbers(name: str) -> Tensor:
        values = plain[name]
        if values and not isinstance(values[0], list):
            values = [math.nan if v is None else v for v in values]
        return torch.tensor(values, dtype=torch.float64)

    return Resolution(
        unit=plain["unit_mm"],
        half_length=plain["half_length_mm"],
        distance=numbers("distance_mm"),
        edge_spread=numbers("edge_spread"),
        mtf=MTF(numbers("frequency_lp_per_mm"), numbers("mtf")),
        patches=numbers("patches_mm"),
        local_lp_per_mm=numbers("local_lp_per_mm"),
    )


def pixels_per_unit(camera: Camera, phantom: Octahedron) -> float:
    """Return pixels per unit of the phantom at the centre of the box: the geometric mean along columns and rows."""
    centre = camera.rotation.new_tensor(phantom.box.centre)
    across = camera.rotation[:2] * (phantom.unit / 2)  # right and down in the image, mm
    spans = (camera.project(centre + across) - camera.project(centre - across)).norm(dim=-1)
    return float(spans.prod().sqrt())
