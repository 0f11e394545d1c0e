"""Index and density on the surface of bodies."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from nerif.data.quantity_names import INDEX
from nerif.data.surface import SurfaceMap
from nerif.fields.field import Field, in_chunks
from nerif.geometry import Box
from nerif.geometry.body import Body, contained, fine_triangles
from nerif.physics.medium import Medium

__all__ = ["surface_map"]

MOST_TRIANGLES = 30_000
OUTWARDS = 1e-3  # of the edges of the triangles, by which points are off the surface


@torch.no_grad()
def surface_map(
    field: Field, bodies: Sequence[Body], box: Box, n_ambient: float, edge: float, quantity: str = INDEX,
    medium: Medium | None = None,
) -> SurfaceMap:  # fmt: skip
    """Return a field, and what follows in a medium, such as density, on the surface of bodies.

    Triangles have edges up to `edge` mm.

    Triangles outside the box are left out; they are larger where there would be more than MOST_TRIANGLES. Vertices
    beyond the box or within another body are NaN.
    """
    field = field.to("cpu")
    points, faces, outside = _within(bodies, box, edge)
    if len(faces) > MOST_TRIANGLES:
        points, faces, outside = _within(bodies, box, edge * (len(faces) / MOST_TRIANGLES) ** 0.5)
    values = torch.cat([field.value(part).double() for part in in_chunks(points.float())])
    values = values.masked_fill(outside, torch.nan)
    quantities, attributes = {quantity: values}, dict[str, float | str]()
    if quantity == INDEX and medium is not None:
        derived = {name: medium.values(values, n_ambient, name)[0] for name in medium.surface_names}
        quantities = {**derived, **quantities}
        attributes = {"n_ambient": n_ambient, **medium.attributes(medium.surface_names[0])}
    return SurfaceMap(points, faces, {n: v.float() for n, v in quantities.items()}, attributes)


def _within(bodies: Sequence[Body], box: Box, edge: float) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices and triangles of bodies that reach into a box, and which vertices have no field."""
    vertices, faces, count = [], [], 0
    for body in bodies:
        corners, triangles, outwards = fine_triangles(body, edge)
        vertices.append(corners + OUTWARDS * edge * outwards)
        faces.append(triangles + count)
        count += len(corners)
    points, every = torch.cat(vertices), torch.cat(faces)
    lower, upper = (points.new_tensor(corner) for corner in (box.lower, box.upper))
    beyond = ((points < lower) | (points > upper)).any(dim=-1)
    used, index = every[~beyond[every].all(dim=1)].unique(return_inverse=True)
    points = points[used]
    return points, index, beyond[used] | contained(bodies, points)
