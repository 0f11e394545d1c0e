"""The box to reconstruct and its voxel grid: volumes are indexed [z, y, x], with values at voxel centres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import FACES, LARGEST_LENGTH, InputError

__all__ = ["Box", "Grid"]

MIN_EDGE = 1e-5  # over the largest coordinate: voxels have to differ in single precision


@dataclass(frozen=True)
class Box:
    """An axis-aligned box with corners (x, y, z) `lower` and `upper`, mm, world frame, at most ten kilometres away."""

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not len(self.lower) == len(self.upper) == 3:
            raise InputError(f"expected corners (x, y, z) in mm, got {self.lower} to {self.upper}", field="box")
        largest = max(abs(c) for c in (*self.lower, *self.upper))
        if not (largest <= LARGEST_LENGTH and all(e > MIN_EDGE * largest for e in self.edges)):
            got = f"{self.lower} to {self.upper}"
            raise InputError(f"expected lower < upper along x, y and z (mm), got {got}", field="box")

    @classmethod
    def cube(cls, edge: float) -> Box:
        """Return a cube of `edge` mm centred on the origin."""
        return cls.around_origin((edge,) * 3)

    @classmethod
    def around_origin(cls, edges: tuple[float, float, float]) -> Box:
        """Return a box with edges along x, y, z (mm), centred on the origin."""
        x, y, z = (e / 2 for e in edges)
        return cls((-x, -y, -z), (x, y, z))

    @classmethod
    def between(cls, lower: tuple[float, float, float] | None, upper: tuple[float, float, float] | None) -> Box | None:
        """Return the box between two corners (mm), None without them; one alone is refused."""
        if (lower is None) != (upper is None):
            raise InputError("expected both corners of the box or neither", field="lower, upper")
        return None if lower is None or upper is None else cls(lower, upper)

    def grown(self, faces: Sequence[str], length: float) -> Box:
        """Return the box with faces such as "z+" moved outwards by a length, mm."""
        corners = [list(self.lower), list(self.upper)]
        for face in faces:
            axis, side = "xyz".index(face[0]), face[1] == "+"
            corners[side][axis] += length if side else -length
        (x0, y0, z0), (x1, y1, z1) = corners
        return Box((x0, y0, z0), (x1, y1, z1))

    @property
    def edges(self) -> tuple[float, float, float]:
        """Edge lengths along x, y, z, mm."""
        x, y, z = (b - a for a, b in zip(self.lower, self.upper, strict=True))
        return (x, y, z)

    @property
    def centre(self) -> tuple[float, float, float]:
        """Centre, mm."""
        x, y, z = ((a + b) / 2 for a, b in zip(self.lower, self.upper, strict=True))
        return (x, y, z)

    def holds(self, other: Box) -> bool:
        """Return whether another box lies within this one, to a nanometre."""
        pairs = (*zip(self.lower, other.lower, strict=True), *zip(other.upper, self.upper, strict=True))
        return all(a <= b + 1e-6 for a, b in pairs)

    def face_points(self, face: str, unit: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        """Map points of the unit square onto a face such as ``"x-"``, mm."""
        axis, side = FACES.index(face) // 2, FACES.index(face) % 2
        lower, edges = unit.new_tensor(self.lower), unit.new_tensor(self.edges)
        inside = torch.full_like(unit[:, :1], float(side))
        relative = torch.cat([unit[:, :axis], inside, unit[:, axis:]], dim=1)
        return lower + relative * edges


@dataclass(frozen=True)
class Grid:
    """Voxels filling a box (mm), `shape` (nz, ny, nx) of them along z, y, x."""

    box: Box
    shape: tuple[int, int, int]

    def __post_init__(self) -> None:
        if len(self.shape) != 3 or not all(isinstance(n, int) and n > 0 for n in self.shape):
            raise InputError(f"expected three positive voxel counts (z, y, x), got {self.shape}", field="grid")

    @classmethod
    def of_resolution(cls, box: Box, voxels: int) -> Grid:
        """Return the grid of near-cubic voxels with `voxels` of them along the longest edge of the box."""
        if not voxels >= 1:
            raise InputError(f"expected at least 1 along the longest edge, got {voxels}", field="voxels")
        size = max(box.edges) / voxels
        nx, ny, nz = (max(1, round(e / size)) for e in box.edges)
        return cls(box, (nz, ny, nx))

    @property
    def spacing(self) -> tuple[float, float, float]:
        """Voxel edges along x, y, z, mm."""
        nz, ny, nx = self.shape
        ex, ey, ez = self.box.edges
        return (ex / nx, ey / ny, ez / nz)

    def axis(self, name: str, dtype: torch.dtype = torch.float64) -> Float[Tensor, " n"]:
        """Return voxel-centre coordinates along ``"x"``, ``"y"`` or ``"z"``, mm."""
        i = "xyz".index(name)
        n = self.shape[2 - i]
        return self.box.lower[i] + (torch.arange(n, dtype=dtype) + 0.5) * self.spacing[i]

    @property
    def x(self) -> Float[Tensor, " x"]:
        """Voxel-centre coordinates along x, mm."""
        return self.axis("x")

    @property
    def y(self) -> Float[Tensor, " y"]:
        """Voxel-centre coordinates along y, mm."""
        return self.axis("y")

    @property
    def z(self) -> Float[Tensor, " z"]:
        """Voxel-centre coordinates along z, mm."""
        return self.axis("z")

    def points(self, dtype: torch.dtype = torch.float32) -> Float[Tensor, "z y x 3"]:
        """Return voxel centres, mm."""
        z, y, x = torch.meshgrid(self.axis("z"), self.axis("y"), self.axis("x"), indexing="ij")
        return torch.stack([x, y, z], dim=-1).to(dtype)
