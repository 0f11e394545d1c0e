"""Spatial resolution by the octahedron phantom, over all faces and place by place (paper, App. D).

The gradient of the phantom has a step at its eight faces. With N the outward normal of a face, t the distance from it
along N and g the true step sqrt(3) amplitude / unit,

    ESF(t) = N . grad n(t) / g

and the resolution is that of its modulation transfer function (mtf.py). How the profiles are taken:

- All have one half length L, so that places can be compared. They stand on the part of a face where they end a margin
  (0.05 units) before the planes x, y, z = 0, beyond which the gradient steps again: |x|, |y|, |z| >= L / sqrt(3) +
  margin. From there their outer end always lies within the box. L = 0.4 units leaves 44 % of every edge, 19 % of a
  face; the window alone then has 1.5 lp/unit.
- Where the whole phantom is blurred, the steps beyond the ends come in as well: 2 % at sigma = L / 4, 5 % (single
  patches 8 %) at L / 3.
- Profiles are averaged over a patch, or over all faces, before they are differentiated; the scatter of neighbouring
  patches shows how much noise is left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.fields.base import Field, in_chunks
from nerif.fields.phantoms import Octahedron
from study.mtf import COARSEST, MTF

__all__ = ["SIZE", "Resolution", "measure_resolution"]

SIZE = 1.5  # units from the centre of the octahedron to its corners
MARGIN = 0.05  # units


@dataclass(frozen=True)
class Resolution:
    """Spatial resolution of a reconstructed octahedron; NaN and 0 as in `MTF.resolution`.

    Parameters
    ----------
    unit : mm
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
        """Of the profile averaged over all faces, line pairs per mm."""
        return float(self.mtf.resolution)

    @property
    def lp_per_unit(self) -> float:
        """Line pairs per unit of the paper, a quarter of the shortest edge of the box."""
        return self.lp_per_mm * self.unit

    @property
    def mtf_per_unit(self) -> MTF:
        """The MTF over lp/unit."""
        return MTF(self.mtf.frequency * self.unit, self.mtf.transfer)

    @property
    def local_lp_per_unit(self) -> Float[Tensor, " k"]:
        """Line pairs per unit at every patch."""
        return self.local_lp_per_mm * self.unit

    @property
    def coarsest(self) -> float:
        """What the window alone has, lp/unit; nothing coarser can be found."""
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
    field: Field,
    phantom: Octahedron,
    half_length: float = 0.4,
    patches: int = 4,
    points: int = 4,
    samples: int = 256,
    device: torch.device | str = "cpu",
) -> Resolution:
    """Measure the spatial resolution of a reconstruction of the octahedron.

    Parameters
    ----------
    field : the reconstruction
    phantom : what was to be reconstructed
    half_length : L, units
    patches : every face is split into patches^2 triangles of equal size
    points : every such triangle has points^2 profiles, evenly spread
    samples : per unit, along a profile; their Nyquist frequency is samples / 2 lp/unit
    device : where the field is

    Raises
    ------
    InputError
        If no place of a face has room for a profile of that length, or a count is not positive.
    """
    longest = math.sqrt(3) * (SIZE / 3 - MARGIN)
    if not 0 < half_length < longest:
        raise InputError(
            f"half_length: expected 0 to {longest:.2f} units, got {half_length}; it must fit the octahedron"
        )
    if min(patches, points) < 1 or samples * half_length < 4:
        raise InputError(
            "expected patches and points of at least 1 and at least 4 samples in half_length, "
            f"got {patches}, {points} and {samples * half_length:g}"
        )
    unit = phantom.unit
    triangles = _split(_inner_faces(phantom, half_length), patches)
    places = _split(triangles, points).mean(dim=1)
    normals = (places - places.new_tensor(phantom.box.centre)).sign() / math.sqrt(3)
    count = round(samples * half_length)
    # half a sample off the face, so that rounding does not decide on which side of the step one lies
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
    """Corners (mm) of what remains of each face where profiles of that half length (units) have room."""
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
