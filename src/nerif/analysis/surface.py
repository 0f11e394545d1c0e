"""Index and density on the surface of bodies."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from nerif.data.surface import SurfaceMap
from nerif.data.volume import INDEX
from nerif.fields.base import Field, in_chunks
from nerif.geometry import Box
from nerif.geometry.body import Body, contained, fine_triangles
from nerif.physics.gas_optics import density_from_index, gladstone_dale
from nerif.physics.quantities import GasSettings

__all__ = ["surface_map"]

OUTWARDS = 1e-3  # of the edges of the triangles, by which points are off the surface


@torch.no_grad()
def surface_map(
    field: Field, bodies: Sequence[Body], box: Box, n_ambient: float, edge: float, quantity: str = INDEX,
    gas: GasSettings | None = None,
) -> SurfaceMap:  # fmt: skip
    """Return a field, and of an index the density, on the surface of bodies in triangles with edges up to `edge` mm.

    Where the surface is outside the box, or within another body, it is NaN.
    """
    vertices, faces, count = [], [], 0
    for body in bodies:
        corners, triangles, outwards = fine_triangles(body, edge)
        vertices.append(corners + OUTWARDS * edge * outwards)
        faces.append(triangles + count)
        count += len(corners)
    points = torch.cat(vertices)
    lower, upper = (points.new_tensor(corner) for corner in (box.lower, box.upper))
    outside = ((points < lower) | (points > upper)).any(dim=-1) | contained(bodies, points)
    values = torch.cat([field.value(part).cpu().double() for part in in_chunks(points.float())])
    values = values.masked_fill(outside, torch.nan)
    quantities, attributes = {quantity: values}, dict[str, float | str]()
    if quantity == INDEX:
        gas = gas or GasSettings()
        k = gladstone_dale(gas.composition, gas.wavelength_nm)
        quantities = {"density": density_from_index(values, n_ambient, k), **quantities}
        attributes = {"n_ambient": n_ambient, "gas": gas.composition, "gladstone_dale_m3_kg-1": k}
    return SurfaceMap(points, torch.cat(faces), {n: v.float() for n, v in quantities.items()}, attributes)
