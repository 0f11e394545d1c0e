"""Spatial resolution by the octahedron phantom, over all faces and place by place (paper, App. D).

The gradient of the phantom has a step at its eight faces. With N the outward normal of a face, t the distance from it
along N, g the true step sqrt(3) amplitude / unit and w a window,

    ESF(t) = N . grad n(t) / g,     LSF = d ESF / dt,     MTF(f) = |DFT(w LSF)|(f) / |DFT(w LSF)|(0)

The resolution is the frequency at which the MTF first falls below 10 %; for a Gaussian blur sigma,
sqrt(2 ln 10) / (2 pi sigma). The profiles, -L <= t <= L:

- All have one half length L, so that places can be compared. They stand on the part of a face where they end a margin
  (0.05 units) before the planes x, y, z = 0, beyond which the gradient steps again: |x|, |y|, |z| >= L / sqrt(3) +
  margin. From there their outer end always lies within the box. L = 0.4 units leaves 44 % of an edge, 19 % of a face.
- Where the whole phantom is blurred, the steps beyond the ends come in as well: 2 % at sigma = L / 4, 5 % (single
  patches 8 %) at L / 3.
- Profiles are averaged over a patch, or over all faces, before they are differentiated: the derivative of a single one
  is mostly noise. Variation of the edge position within an average counts as blur; remaining noise raises the MTF. The
  scatter of neighbouring patches shows how much noise remains.

The transform:

- The Tukey window w, 1 over |t| <= L / 2 with a cosine taper to 0 at L, removes noise and slow slopes at the ends. It
  changes the resolution of a Gaussian edge by less than 0.1 % up to sigma = L / 5 and 0.8 % up to L / 3, and
  overestimates it by 13 % at L / 2. The window alone has 0.6 / L (1.5 lp/unit), the lower limit of any result.
- Zero-padding interpolates the transform.
- A difference over one sample h multiplies the MTF by sinc(f h), which is divided out.
"""

from __future__ import annotations

import math
from itertools import product
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.fields.field import Field, in_chunks
from nerif.fields.phantoms import Octahedron
from nerif.geometry import Camera

SIZE = 1.5  # units from the centre of the octahedron to its corners
MARGIN = 0.05  # units
HALF_LENGTH = 0.4  # units, L
PATCHES, POINTS = 4, 4  # a face has PATCHES^2 triangles of equal size, a triangle POINTS^2 profiles, evenly spread
SAMPLES = 256  # per unit, along a profile; their Nyquist frequency is SAMPLES / 2 lp/unit
THRESHOLD = 0.1  # of the MTF
MIN_STEP = 0.1  # of the true step: less is no edge
PADDING = 20  # times as many zeros as samples


@torch.no_grad()
def measure_resolution(field: Field, phantom: Octahedron, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Measure the spatial resolution of a reconstruction of the octahedron; return numbers and lists.

    unit_mm : a quarter of the shortest edge of the box
    lp_per_unit, local_lp_per_unit : line pairs; of the profile averaged over all faces, and over each patch (k,); NaN
        if finer than the samples resolve, 0 without an edge
    distance_mm, edge_spread : (t,) from the face, outward; ESF averaged over all faces, -1 inside and 0 outside
    frequency_lp_per_unit, mtf : (f,) of it
    patches_mm : (k, 3, 3) corners of the triangles of the faces
    """
    triangles = _split(_inner_faces(phantom), PATCHES)
    places = _split(triangles, POINTS).mean(dim=1)
    normals = (places - places.new_tensor(phantom.box.centre)).sign() / math.sqrt(3)
    count = round(SAMPLES * HALF_LENGTH)
    # half a sample off the face, so that rounding does not decide the side of the step
    distance = (torch.arange(-count, count, dtype=torch.float64) + 0.5) * (phantom.unit / SAMPLES)

    true_step = math.sqrt(3) * phantom.amplitude / phantom.unit
    spread = torch.empty(len(places), len(distance), dtype=torch.float64)
    for rows in in_chunks(torch.arange(len(places)), max(1, (1 << 13) // len(distance))):
        line = places[rows, None] + distance[:, None] * normals[rows, None]
        gradient = field.gradient(line.reshape(-1, 3).to(device, torch.float32)).cpu().double()
        spread[rows] = (gradient.reshape(line.shape) * normals[rows, None]).sum(-1) / true_step
    local = spread.reshape(len(triangles), -1, len(distance)).mean(dim=1)
    overall = local.mean(dim=0)
    frequency, mtf = transfer_function(overall, 1 / SAMPLES)
    return {
        "unit_mm": phantom.unit,
        "lp_per_unit": float(cutoff(frequency, mtf)),
        "local_lp_per_unit": cutoff(*transfer_function(local, 1 / SAMPLES)).tolist(),
        "distance_mm": distance.tolist(),
        "edge_spread": overall.tolist(),
        "frequency_lp_per_unit": frequency.tolist(),
        "mtf": mtf.tolist(),
        "patches_mm": triangles.tolist(),
    }


def transfer_function(
    edge_spread: Float[Tensor, "*batch t"], step: float
) -> tuple[Float[Tensor, " f"], Float[Tensor, "*batch f"]]:
    """Return frequency, up to Nyquist, and MTF of edges sampled every `step`; the true edge is a step from -1 to 0.

    The MTF is NaN where there is no edge.
    """
    line = edge_spread.diff(dim=-1)
    n = line.shape[-1]
    place = (torch.arange(n, dtype=torch.float64) - (n - 1) / 2).abs() / ((n + 1) / 2)
    line = line * 0.5 * (1 + torch.cos(math.pi * (2 * place - 1).clamp(min=0)))  # the window
    padded = PADDING * edge_spread.shape[-1]
    frequency = torch.arange(padded // 2 + 1, dtype=torch.float64) / (padded * step)
    height = line.sum(-1, keepdim=True)
    height = torch.where(height >= MIN_STEP, height, math.nan)
    return frequency, torch.fft.rfft(line, padded).abs() / height / torch.sinc(frequency * step)


def cutoff(frequency: Float[Tensor, " f"], mtf: Float[Tensor, "*batch f"]) -> Float[Tensor, "*batch"]:
    """Return the frequency at which the MTF first falls below 10 %.

    NaN if it stays above 10 % up to the Nyquist frequency; 0 if there is no edge.
    """
    first = ((mtf < THRESHOLD).cumsum(-1) == 0).sum(-1, keepdim=True)
    i = first.clamp(1, len(frequency) - 1)
    before, after = mtf.gather(-1, i - 1), mtf.gather(-1, i)
    crossing = frequency[i - 1] + (before - THRESHOLD) / (before - after) * (frequency[1] - frequency[0])
    crossing = torch.where(first < len(frequency), crossing, math.nan)
    return torch.where(mtf[..., :1].isnan(), 0.0, crossing).squeeze(-1)


def _inner_faces(phantom: Octahedron) -> Float[Tensor, "8 3 3"]:
    """Corners (mm) of the part of each face where the profiles fit."""
    least = HALF_LENGTH / math.sqrt(3) + MARGIN
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


def pixels_per_unit(camera: Camera, phantom: Octahedron) -> float:
    """Return pixels per unit of the phantom at the centre of the box: the geometric mean along columns and rows."""
    centre = camera.rotation.new_tensor(phantom.box.centre)
    across = camera.rotation[:2] * (phantom.unit / 2)  # right and down in the image, mm
    spans = (camera.project(centre + across) - camera.project(centre - across)).norm(dim=-1)
    return float(spans.prod().sqrt())
