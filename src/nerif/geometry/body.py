"""Opaque bodies in the flow, such as a wind-tunnel model: closed meshes of triangles in the world frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations, product
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerif.common.arrays import Matrix3, Points, Values
from nerif.common.conventions import InputError, check_name
from nerif.geometry.camera import Camera
from nerif.geometry.grid import Box
from nerif.geometry.rays import Rays

if TYPE_CHECKING:
    from nerif.geometry.mesh_kernel import Tree

__all__ = [
    "UNITS", "Body", "check_place", "contained", "fine_triangles", "from_surface", "hidden_pixels", "is_thin",
    "orientations",
]  # fmt: skip

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}  #: lengths of models in files, mm
LENS_RAYS = 16  # per pixel with a lens or a window
RAYS_AT_A_TIME = 1 << 16
MANY = 512  # points, for which several threads are worth while
THICKNESS_POINTS, THIN_SHARE = 2000, 0.05  # of the surface; the share that makes a body thin
MOST_PARTS = 200  # of the edge of a triangle
TOUCHING = 1e-4  # of the reach, below which a point is on the surface: n is that of the triangle
CORNER = 1e-9  # of barycentric coordinates: 0
TINY, LARGE = 0.01, 20.0  # of the box, beyond which the size of a body is not meant


@dataclass(frozen=True, eq=False)
class Body:
    """A closed mesh of triangles, which light does not pass; InputError for one that is open, inside out or flat."""

    vertices: Float[Tensor, "n 3"]  #: corners of the triangles, mm, world frame
    faces: Int[Tensor, "m 3"]  #: vertices of each, counter-clockwise as seen from outside; turned if all face inwards
    name: str = "body"  #: in messages

    def __post_init__(self) -> None:
        def check(valid: bool, expected: str, got: object) -> None:
            if not valid:
                raise InputError(f"expected {expected}, got {got}", field=self.name)

        check_name(self.name, "body")
        vertices, faces = self.vertices, self.faces
        check(vertices.ndim == 2 and vertices.shape[1] == 3, "vertices (n, 3) in mm", tuple(vertices.shape))
        shape = tuple(faces.shape)
        check(faces.ndim == 2 and shape[1:] == (3,) and shape[0] > 3, "at least four triangles (m, 3)", shape)
        check(bool(vertices.isfinite().all()), "finite vertices", "NaN or infinity")
        inside = int(faces.min()) >= 0 and int(faces.max()) < len(vertices)
        check(inside, f"triangles of vertices 0 to {len(vertices) - 1}", f"{int(faces.min())} to {int(faces.max())}")
        object.__setattr__(self, "vertices", vertices.double().contiguous())
        object.__setattr__(self, "faces", faces.long().contiguous())
        lonely, against = self._edges
        remedy = "; fill the holes, and export it as one solid with a finer tolerance"
        check(not lonely, "a closed surface", f"{lonely} edges without the neighbouring triangle{remedy}")
        remedy = "; unify the normals of the model, and export it again"
        wrong = f"{against} edges whose triangles face opposite sides{remedy}"
        check(not against, "triangles that all face outwards", wrong)
        check(self.volume != 0, "a body", "a surface without a volume; a sheet needs a thickness")
        if self.volume < 0:
            object.__setattr__(self, "faces", self.faces.flip(1))

    @property
    def _edges(self) -> tuple[int, int]:
        """Numbers of edges with an odd number of triangles, and of others not passed equally often both ways."""
        tails, heads = self.faces.flatten(), self.faces.roll(-1, dims=1).flatten()
        codes = torch.minimum(tails, heads) * len(self.vertices) + torch.maximum(tails, heads)
        _, edge, count = codes.unique(return_inverse=True, return_counts=True)
        balance = torch.zeros(len(count), dtype=torch.long)
        balance.index_add_(0, edge, torch.where(tails < heads, 1, -1))
        odd = count % 2 != 0
        return int(odd.sum()), int(((balance != 0) & ~odd).sum())

    @property
    def corners(self) -> Float[Tensor, "m 3 3"]:
        """The corners of each triangle, mm."""
        return self.vertices[self.faces]

    @property
    def volume(self) -> float:
        """Enclosed volume, mm3."""
        a, b, c = (self.corners - self.vertices.mean(dim=0)).unbind(dim=1)
        return float((a * torch.linalg.cross(b, c)).sum()) / 6

    @property
    def normals(self) -> Float[Tensor, "m 3"]:
        """Outward unit normals of the triangles; 0 for a triangle without area."""
        a, b, c = self.corners.unbind(dim=1)
        return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)

    @property
    def extent(self) -> tuple[Float[Tensor, 3], Float[Tensor, 3]]:
        """Lower and upper corner of the smallest box about it, mm."""
        return self.vertices.amin(dim=0), self.vertices.amax(dim=0)

    def moved(self, rotation: Matrix3, translation: Float[Tensor, 3]) -> Body:
        """Return the body at R x + t, mm."""
        return replace(self, vertices=self.vertices @ rotation.double().T + translation.double())

    def in_units(self, centre: tuple[float, float, float], unit: float) -> Body:
        """Return the body in coordinates (x - centre) / unit."""
        return replace(self, vertices=(self.vertices - self.vertices.new_tensor(centre)) / unit)

    @cached_property
    def _tree(self) -> Tree:
        from nerif.geometry.mesh_kernel import tree_of

        return tree_of(self.vertices.numpy(), self.faces.numpy())

    def hits(self, rays: Rays) -> Values:
        """Return the path lengths (mm) at which rays meet the body before their background; infinity if they do not."""
        from nerif.geometry.mesh_kernel import first_hits

        end = torch.full_like(rays.near, torch.inf) if rays.background is None else rays.background.distance
        parts = (rays.origin, rays.direction, rays.begin, end)
        arrays = [part.detach().cpu().double().contiguous().numpy() for part in parts]
        count = len(rays)

        def piece(first: int) -> np.ndarray:
            return first_hits(self._tree, *(a[first : first + RAYS_AT_A_TIME] for a in arrays))

        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            parts_of_rays = list(pool.map(piece, range(0, count, RAYS_AT_A_TIME)))
        return torch.from_numpy(np.concatenate([*parts_of_rays, np.empty(0)])).to(rays.near)

    def contains(self, points: Points) -> Bool[Tensor, "*batch"]:
        """Return which points (mm) are inside."""
        from nerif.geometry.mesh_kernel import windings

        flat = points.detach().reshape(-1, 3).cpu().double()
        lower, upper = self.extent
        near = ((flat >= lower) & (flat <= upper)).all(dim=-1)
        inside = torch.zeros(len(flat), dtype=torch.bool)
        inside[near] = torch.from_numpy(windings(self._tree, flat[near].contiguous().numpy()) > 0)
        return inside.reshape(points.shape[:-1]).to(points.device)

    def closest(self, points: Points) -> tuple[Points, Int[Tensor, "*batch"]]:
        """Return the points of the surface that are closest to points (mm), and their triangles."""
        from nerif.geometry.mesh_kernel import closest

        flat = points.detach().reshape(-1, 3).cpu().double().contiguous()
        where, _, face = (torch.from_numpy(part) for part in closest(self._tree, flat.numpy(), np.inf))
        return where.reshape(points.shape).to(points), face.reshape(points.shape[:-1]).to(points.device)

    def distance(self, points: Points) -> Values:
        """Return the distances of points (mm) from the surface, mm, below 0 inside."""
        distance = (self.closest(points)[0] - points).norm(dim=-1)
        return torch.where(self.contains(points), -distance, distance)


def is_thin(body: Body, thickness: float) -> bool:
    """Return whether a part of a body is thinner than a length, mm, along its inward normals."""
    from nerif.geometry.mesh_kernel import first_hits

    generator = torch.Generator().manual_seed(0)
    a, b, c = body.corners.unbind(dim=1)
    areas = torch.linalg.cross(b - a, c - a).norm(dim=-1)
    face = torch.multinomial(areas, THICKNESS_POINTS, replacement=True, generator=generator)
    weights = torch.rand(THICKNESS_POINTS, 2, generator=generator, dtype=torch.float64)
    weights = torch.where(weights.sum(dim=1, keepdim=True) > 1, 1 - weights, weights)  # of an even distribution
    points = a[face] + weights[:, :1] * (b - a)[face] + weights[:, 1:] * (c - a)[face]
    inwards, end = -body.normals[face], torch.full_like(areas[face], thickness)
    hits = first_hits(body._tree, *(part.contiguous().numpy() for part in (points, inwards, 1e-6 * end, end)))
    return float(np.isfinite(hits).mean()) > THIN_SHARE


def fine_triangles(body: Body, edge: float) -> tuple[Float[Tensor, "n 3"], Int[Tensor, "m 3"], Float[Tensor, "n 3"]]:
    """Return the surface in triangles whose edges are at most `edge` (mm): vertices, triangles, outward normals.

    Each triangle is divided evenly and keeps vertices of its own, so creases stay sharp.
    """
    corners, normals = body.corners, body.normals
    longest = (corners - corners.roll(1, dims=1)).norm(dim=-1).amax(dim=1)
    parts = (longest / edge).ceil().clamp(1, MOST_PARTS).long()
    vertices, faces, outwards, count = [], [], [], 0
    for k in parts.unique().tolist():
        index = (parts == k).nonzero().flatten()
        weights, small = _divided(k)
        vertices.append((weights @ corners[index]).reshape(-1, 3))
        first = count + torch.arange(len(index))[:, None, None] * len(weights)
        faces.append((small + first).reshape(-1, 3))
        outwards.append(normals[index].repeat_interleave(len(weights), dim=0))
        count += len(index) * len(weights)
    return torch.cat(vertices), torch.cat(faces), torch.cat(outwards)


def _divided(parts: int) -> tuple[Float[Tensor, "w 3"], Int[Tensor, "p 3"]]:
    """Barycentric coordinates of the vertices, and the parts^2 triangles, of a triangle with edges in equal parts."""
    places = [(i, j) for i in range(parts + 1) for j in range(parts + 1 - i)]
    number = {place: n for n, place in enumerate(places)}
    weights = torch.tensor([(parts - i - j, i, j) for i, j in places], dtype=torch.float64) / parts
    small = [(number[i, j], number[i + 1, j], number[i, j + 1]) for i, j in places if i + j < parts]
    small += [(number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]) for i, j in places if i + j < parts - 1]
    return weights, torch.tensor(small)


def contained(bodies: Sequence[Body], points: Points) -> Bool[Tensor, "*batch"]:
    """Return which points (mm) are inside any of the bodies."""
    inside = torch.zeros(points.shape[:-1], dtype=torch.bool, device=points.device)
    for body in bodies:
        inside |= body.contains(points)
    return inside


def from_surface(
    bodies: Sequence[Body], points: Points, reach: float
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Return the direction from the nearest surface, faded with the distance d from it, and its derivative.

        v = (1 - (d / reach)^2)^2 n,    n = grad d,    dv/dx = w' n n^T + w H

    H, the Hessian of d, is 0 beside a face, (1 - n n^T - t t^T) / d beside an edge along t, (1 - n n^T) / d beside a
    vertex. Beyond `reach` both are 0.
    """
    from nerif.geometry.mesh_kernel import closest

    threads = torch.get_num_threads()
    flat = points.detach().cpu().double().contiguous()
    best = torch.full((len(flat),), torch.inf, dtype=torch.float64)
    v, slope = torch.zeros_like(flat), flat.new_zeros(len(flat), 3, 3)
    with ThreadPoolExecutor(threads) as pool:
        for body in bodies:
            lower, upper = body.extent
            near = ((flat > lower - reach) & (flat < upper + reach)).all(dim=-1).nonzero().flatten()
            pieces = flat[near].chunk(threads if len(near) > MANY else 1)
            nearest = list(pool.map(lambda piece, body=body: closest(body._tree, piece.numpy(), reach), pieces))
            where, weights, face = (torch.from_numpy(np.concatenate(part)) for part in zip(*nearest, strict=True))
            offset = flat[near] - where
            distance = offset.norm(dim=-1)
            nearer = (distance < best[near]).nonzero().flatten()  # not if it is NaN
            d, index = distance[nearer].clamp_min(TOUCHING * reach), near[nearer]
            touching = distance[nearer] < TOUCHING * reach
            n = torch.where(touching[:, None], body.normals[face[nearer]], offset[nearer] / d[:, None])
            u = d / reach
            w, fall = (1 - u**2) ** 2, -4 * u * (1 - u**2) / reach
            bend = _bend(n, weights[nearer], body.corners[face[nearer]]) / d[:, None, None]
            best[index], v[index] = distance[nearer], w[:, None] * n
            slope[index] = fall[:, None, None] * n[:, :, None] * n[:, None] + w[:, None, None] * bend
    return v.to(points), slope.to(points)


def _bend(
    n: Float[Tensor, "n 3"], weights: Float[Tensor, "n 3"], corners: Float[Tensor, "n 3 3"]
) -> Float[Tensor, "n 3 3"]:
    """Distance times its Hessian, for its gradient n and barycentric coordinates of the nearest point of a triangle."""
    zero = weights <= CORNER
    across = torch.eye(3).to(n) - n[:, :, None] * n[:, None]
    opposite = zero.long().argmax(dim=1)  # of the edge that has the point, if one coordinate is 0
    row = torch.arange(len(n))
    edge = corners[row, (opposite + 2) % 3] - corners[row, (opposite + 1) % 3]
    along = torch.nn.functional.normalize(edge, dim=-1)
    on_edge = across - along[:, :, None] * along[:, None]
    zeros = zero.sum(dim=1)[:, None, None]
    return torch.where(zeros == 0, 0.0, torch.where(zeros == 1, on_edge, across))


def hidden_pixels(camera: Camera, bodies: Sequence[Body], margin: int = 0, step: int = 1) -> Bool[Tensor, "row column"]:
    """Return the pixels of a camera that see a body, with any part of their lens or window.

    A body so thin that no pixel sees it with its centre hides the pixels on which it lies.

    Parameters
    ----------
    margin : pixels added all around
    step : rows and columns from one pixel of the result to the next
    """
    pixels = camera.pixel_grid()[::step, ::step]
    hidden = torch.zeros(pixels.shape[:2], dtype=torch.bool)
    for body in bodies:
        of_body = _seen(camera, body, pixels)
        hidden |= of_body if bool(of_body.any()) else _touched(camera, body, pixels.shape[:2], step)
    if margin:
        grown = torch.nn.functional.max_pool2d(hidden[None].float(), 2 * margin + 1, 1, margin)
        hidden = grown[0] > 0
    return hidden


def _seen(camera: Camera, body: Body, pixels: Float[Tensor, "row column 2"]) -> Bool[Tensor, "row column"]:
    """Which pixels see a body with any part of their lens or window."""
    hidden = torch.zeros(pixels.shape[:2], dtype=torch.bool)
    each = LENS_RAYS if camera.lens is not None and (camera.lens.diameter > 0 or camera.lens.window > 0) else 1
    rows = max(1, RAYS_AT_A_TIME // pixels.shape[1])
    for first in range(0, len(pixels), rows):
        part = pixels[first : first + rows]
        rays = camera.rays(part.reshape(-1, 2))
        for bundle in [rays] if each == 1 else [rays, rays.spread(each)]:
            hit = body.hits(bundle).isfinite().reshape(*part.shape[:2], -1).any(dim=-1)
            hidden[first : first + rows] |= hit
    return hidden


def _touched(camera: Camera, body: Body, shape: tuple[int, ...], step: int) -> Bool[Tensor, "row column"]:
    """The pixels on which the surface of a body lies."""
    width = float(camera.pixel_size(body.vertices.mean(dim=0)[None])[0])
    points, _, _ = fine_triangles(body, width / 2)
    pixels = camera.project(points)
    column, row = (pixels / step).round().nan_to_num(-1).long().unbind(-1)
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    points, row, column = points[inside], row[inside], column[inside]
    rays = camera.rays(pixels[inside].to(camera.intrinsics.dtype))
    length = ((points - rays.origin) * rays.direction).sum(dim=-1)
    end = torch.full_like(length, torch.inf) if rays.background is None else rays.background.distance
    before = (length > rays.begin) & (length < end)
    touched = torch.zeros(shape[0], shape[1], dtype=torch.bool)
    touched[row[before], column[before]] = True
    return touched


def orientations() -> Iterator[tuple[str, Matrix3]]:
    """Yield the other ways to name the axes of a model, and their matrices; the mirrored ones first."""
    every = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = torch.zeros(3, 3, dtype=torch.float64)
            for i, (axis, sign) in enumerate(zip(order, signs, strict=True)):
                matrix[i, axis] = sign
            name = ", ".join("-" * (sign < 0) + "xyz"[axis] for axis, sign in zip(order, signs, strict=True))
            every.append((order != (0, 1, 2), signs.count(-1.0), f"({name})", matrix))
    yield from ((name, matrix) for _, _, name, matrix in sorted(every, key=lambda entry: entry[:3])[1:])


def check_place(body: Body, box: Box, unit_stated: bool = False) -> None:
    """Raise an InputError for a body that is not in a box, or whose size is not meant, with the likely cause.

    Parameters
    ----------
    unit_stated : whether the user stated the unit of its lengths, so that a small body is meant
    """
    lower, upper = (torch.tensor(corner, dtype=torch.float64) for corner in (box.lower, box.upper))
    first, last = body.extent

    def meets(matrix: Matrix3) -> bool:
        a, b = first @ matrix.T, last @ matrix.T
        return bool(((torch.minimum(a, b) < upper) & (torch.maximum(a, b) > lower)).all())

    size, edge, one = float((last - first).max()), max(box.edges), torch.eye(3, dtype=torch.float64)
    extent = " x ".join(f"{a:.4g}..{b:.4g}" for a, b in zip(first.tolist(), last.tolist(), strict=True)) + " mm"
    if size > LARGE * edge or (size < TINY * edge and not unit_stated):
        factors = [a / b for a, b in product(UNITS.values(), repeat=2)]
        suits = [f"{k:.4g}" for k in factors if 0.05 * edge < k * size < 5 * edge and meets(k * one)]
        cause = f"; times {suits[0]} it would: check --unit" if suits else "; check --unit"
        if f"{UNITS['m']:.4g}" in suits:
            cause = "; its lengths may be in m: --unit m"
        raise InputError(
            f"expected a body that suits the box of {edge:g} mm, got one of {extent} (x, y, z){cause}", field=body.name
        )
    if meets(one):
        return
    causes = [f"with its axes as {name} it would be in it" for name, matrix in orientations() if meets(matrix)]
    cause = causes[0] if causes else "give its place with --translation and --rotation"
    raise InputError(f"expected a body in the box, got one of {extent} (x, y, z) outside; {cause}", field=body.name)
