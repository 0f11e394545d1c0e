"""Axisymmetric, nearly axisymmetric and planar fields: coordinates in which the field is constant.

With w = F (x - p), F the frame (rows e1, e2, e3) and p a point,

    axis      (r, h) = (sqrt(w1^2 + w2^2 + d^2), w3)     e3 along the axis through p, d a small length
    planar    (r, h) = (w1, w3)                           e2 along the direction in which the field is constant

A nearly axisymmetric field has N azimuthal harmonics as well: with u = (w1 + i w2) / r,

    f(x) = sum_k D_k(u) f_k(r, h),     D_k = (1 + 2 sum_m Re(u^m exp(-i m a_k))) / K,    a_k = 2 pi k / K,   K = 2 N + 1

f_k is the field at the azimuth a_k; on the axis only the mean remains.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.arrays import Points, Vectors
from nerif.common.conventions import FACES, InputError
from nerif.geometry.grid import Box
from nerif.geometry.symmetry_names import MAX_HARMONICS, NO_SYMMETRY, parse_symmetry

__all__ = ["NAMES", "NO_SYMMETRY", "Axis", "Symmetry", "parse_symmetry"]

COS_45 = math.cos(math.radians(45))  # faces whose normals are further than 45 degrees from a direction lie along it
MAX_POSTERIOR = 0.5  # of the prior standard deviation, of a parameter that the data constrain
NAMES = ("shift_1", "shift_2", "lean_1", "lean_2")
"""Shifts (mm) of an axis along e1 and e2 of the frame, leans (rad) towards them."""


@dataclass(frozen=True)
class Symmetry:
    """A symmetry of a field."""

    kind: str  #: axis, or planar
    point: tuple[float, float, float]  #: p, mm, on the axis; of a planar field any
    frame: tuple[tuple[float, float, float], ...]
    """(e1, e2, e3), orthonormal; e3 along the axis, or e2 along the direction in which the field is constant."""
    rounding: float  #: d, mm, at least a millionth of the size of the field
    harmonics: int = 0  #: N, of the azimuth

    @classmethod
    def about(
        cls, text: str, point: tuple[float, float, float], direction: tuple[float, float, float], rounding: float
    ) -> Symmetry | None:
        """Return the symmetry of a name (`parse_symmetry`) about a line through a point (mm) in a direction."""
        parsed = parse_symmetry(text)
        if parsed is None:
            return None
        kind, harmonics = parsed
        line = torch.tensor(direction, dtype=torch.float64)
        if not float(line.norm()) > 0:
            raise InputError(f"expected a direction (x, y, z), got {direction}", field="axis_direction")
        line = line / line.norm()
        # e1 as close as possible to the first coordinate axis that is not along the line
        first = torch.eye(3, dtype=torch.float64)[1 if abs(float(line[0])) > COS_45 else 0]
        e1 = first - (first @ line) * line
        e1 = e1 / e1.norm()
        rows = (e1, torch.linalg.cross(line, e1), line)
        if kind == "planar":
            rows = (e1, line, torch.linalg.cross(e1, line))
        frame = tuple((float(a), float(b), float(c)) for a, b, c in (row.tolist() for row in rows))
        return cls(kind, point, frame, rounding, harmonics)

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any]) -> Symmetry:
        """Return the symmetry of the entries of a file (dataclasses.asdict)."""
        x, y, z = entries["point"]
        frame = tuple((a, b, c) for a, b, c in entries["frame"])
        harmonics = int(entries["harmonics"])
        if not 0 <= harmonics <= MAX_HARMONICS:
            raise InputError(f"expected at most {MAX_HARMONICS}, got {harmonics}", field="harmonics")
        return cls(entries["kind"], (x, y, z), frame, float(entries["rounding"]), harmonics)

    @property
    def axial(self) -> bool:
        """Whether the symmetry is about an axis."""
        return self.kind == "axis"

    @property
    def angles(self) -> int:
        """K, the number of azimuths with a field f_k(r, h)."""
        return 2 * self.harmonics + 1

    @property
    def direction(self) -> tuple[float, float, float]:
        """Unit vector along the axis, or in the direction in which the field is constant."""
        return self.frame[2 if self.axial else 1]

    @cached_property
    def matrix(self) -> Float[Tensor, "3 3"]:
        """The frame F."""
        return torch.tensor(self.frame, dtype=torch.float64)

    def local(self, points: Points) -> Points:
        """Return w of points, mm."""
        away = points - points.new_tensor(self.point)
        # written out, since a matrix product may be of reduced precision
        return torch.stack([(away * row).sum(-1) for row in self.matrix.to(points)], dim=-1)

    def reduced(self, points: Points) -> Points:
        """Return (r, 0, h) of points, mm."""
        return self.of_local(self.local(points))

    def of_local(self, w: Points) -> Points:
        """Return (r, 0, h) of points w."""
        x, y, h = w.unbind(-1)
        r = (x * x + y * y + self.rounding**2).sqrt() if self.axial else x
        return torch.stack([r, torch.zeros_like(r), h], dim=-1)

    def gradient(self, w: Points, slope: Vectors) -> Vectors:
        """Return the gradient in space of a field with the slopes d/d(r, -, h) at points w."""
        if self.axial:
            r = (w[..., 0].square() + w[..., 1].square() + self.rounding**2).sqrt()
            along = torch.stack([slope[..., 0] * w[..., 0] / r, slope[..., 0] * w[..., 1] / r, slope[..., 2]], dim=-1)
        else:
            along = torch.stack([slope[..., 0], torch.zeros_like(slope[..., 0]), slope[..., 2]], dim=-1)
        return self._in_space(along)

    def shares(self, w: Points) -> tuple[Float[Tensor, "*n k"], Float[Tensor, "*n k 3"]]:
        """Return D_k at points w, and its gradient in space, 1/mm."""
        count = self.angles
        share = torch.ones(*w.shape[:-1], count, dtype=w.dtype, device=w.device)
        slope = torch.zeros(*share.shape, 3, dtype=w.dtype, device=w.device)
        x, y = w[..., 0], w[..., 1]
        r = (x * x + y * y + self.rounding**2).sqrt()
        u = torch.complex(x, y) / r
        grad_r = torch.stack([x, y], dim=-1) / r[..., None]
        one = torch.tensor([1, 1j], dtype=u.dtype, device=w.device)
        grad_u = (one - u[..., None] * grad_r) / r[..., None]
        angle = 2 * math.pi * torch.arange(count, dtype=w.dtype, device=w.device) / count
        power = torch.ones_like(u)
        for m in range(1, self.harmonics + 1):
            phase = torch.polar(torch.ones_like(angle), -m * angle)
            grad = (m * power)[..., None] * grad_u  # of u^m
            slope[..., :2] += 2 * (grad[..., None, :] * phase[:, None]).real
            power = power * u
            share = share + 2 * (power[..., None] * phase).real
        return share / count, self._in_space(slope / count)

    def _in_space(self, along: Vectors) -> Vectors:
        """Components along x, y, z of vectors with components along e1, e2, e3."""
        return torch.stack([(along * column).sum(-1) for column in self.matrix.to(along).T], dim=-1)

    def places(self, r: Tensor, angle: Tensor, h: Tensor) -> Points:
        """Return the points (mm) at (r, h) and an azimuth, rad; for a planar field in the plane through p."""
        w = torch.stack([r * angle.cos(), r * angle.sin(), h], dim=-1)
        if not self.axial:
            w = torch.stack([r, torch.zeros_like(r), h], dim=-1)
        return w.new_tensor(self.point) + self._in_space(w)

    def move(self, shift: tuple[float, float], turn: tuple[float, float]) -> Symmetry:
        """Return the symmetry shifted along e1 and e2 (mm) and tilted towards them (rad)."""
        frame = self.matrix
        e3 = frame[2] + turn[0] * frame[0] + turn[1] * frame[1]
        e3 = e3 / e3.norm()
        e1 = frame[0] - (frame[0] @ e3) * e3
        e1 = e1 / e1.norm()
        rows = torch.stack([e1, torch.linalg.cross(e3, e1), e3]).tolist()
        point = torch.tensor(self.point, dtype=torch.float64) + shift[0] * frame[0] + shift[1] * frame[1]
        x, y, z = point.tolist()
        return replace(self, point=(x, y, z), frame=tuple((a, b, c) for a, b, c in rows))

    def near(self, other: Symmetry, tolerance: float) -> bool:
        """Return whether another symmetry has the same kind, and p and frame (of an axis e3) within a tolerance."""
        rows = slice(2, 3) if self.axial else slice(3)
        mine, others = ((*s.point, *(x for row in s.frame[rows] for x in row)) for s in (self, other))
        same = (self.kind, self.harmonics) == (other.kind, other.harmonics)
        return same and all(abs(a - b) <= tolerance for a, b in zip(mine, others, strict=True))

    def mixing(self, other: Symmetry) -> Float[Tensor, "k k"]:
        """Return the matrix that makes f_k of this frame from those of another frame with nearly the same axis."""
        turn = torch.atan2(self.matrix[0] @ other.matrix[1], self.matrix[0] @ other.matrix[0])
        angle = 2 * math.pi * torch.arange(self.angles, dtype=torch.float64) / self.angles
        orders = torch.arange(1, self.harmonics + 1, dtype=torch.float64)
        waves = (orders * (angle[:, None] + turn - angle)[..., None]).cos().sum(-1)
        return (1 + 2 * waves) / self.angles

    def in_units(self, centre: tuple[float, float, float], unit: float) -> Symmetry:
        """Return the symmetry in coordinates (x - centre) / unit."""
        x, y, z = ((p - c) / unit for p, c in zip(self.point, centre, strict=True))
        return replace(self, point=(x, y, z), rounding=self.rounding / unit)

    def faces(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the faces in (r, -, h) of faces of a box: x+ for those around an axis, z- and z+."""
        faces = []
        for name in names:
            normal = self.matrix[:, FACES.index(name) // 2] * (1 if name[1] == "+" else -1)
            if self.axial:
                faces.append("x+" if abs(normal[2]) < COS_45 else f"z{'+' if normal[2] > 0 else '-'}")
            elif abs(normal[1]) < COS_45:
                row = 0 if abs(normal[0]) >= COS_45 else 2
                faces.append("xyz"[row] + ("+" if normal[row] > 0 else "-"))
        return tuple(dict.fromkeys(faces))

    def reduced_box(self, box: Box, ambient: tuple[str, ...]) -> Box:
        """Return the box in (r, -, h) of a box in space, mm; about an axis it ends at the nearest ambient face."""
        unit = torch.cartesian_prod(*[torch.tensor([0.0, 1.0], dtype=torch.float64)] * 3)
        w = self.local(torch.tensor(box.lower, dtype=torch.float64) + unit * torch.tensor(box.edges))
        low, high = w.amin(dim=0).tolist(), w.amax(dim=0).tolist()
        if self.axial:
            low[0], high[0] = 0.0, float(w[:, :2].norm(dim=1).max())
            for name in ambient:
                axis, sign = FACES.index(name) // 2, 1 if name[1] == "+" else -1
                if abs(float(self.matrix[2, axis])) < COS_45:
                    face = box.upper[axis] if sign > 0 else box.lower[axis]
                    high[0] = min(high[0], sign * (face - self.point[axis]))
            if not high[0] > 0:
                raise InputError(f"expected the axis within the box, got {self.point} mm", field="axis_point")
        width = (high[0] - low[0]) / 2
        return Box((low[0], -width, low[2]), (high[0], width, high[2]))


@dataclass(frozen=True)
class Axis:
    """A refined axis of symmetry."""

    symmetry: Symmetry
    values: tuple[float, ...]  #: of NAMES, relative to the initial axis
    prior_sigma: tuple[float, ...]
    """Standard deviations of the values before the refinement; 0 for a parameter that was not refined."""
    posterior_sigma: tuple[float, ...]  #: the same after it
    residual: float  #: rms over sigma of a coarse reconstruction (over the rms of the data, if sigma is unknown)

    @property
    def constrained(self) -> tuple[bool, ...]:
        """Whether the data constrain each of the parameters."""
        pairs = zip(self.prior_sigma, self.posterior_sigma, strict=True)
        return tuple(prior > 0 and after < MAX_POSTERIOR * prior for prior, after in pairs)

    @property
    def record(self) -> dict[str, Any]:
        """Entries of metrics.json."""
        columns = {
            "values": self.values,
            "prior_sigma": self.prior_sigma,
            "posterior_sigma": self.posterior_sigma,
            "constrained": self.constrained,
        }
        named = {key: dict(zip(NAMES, column, strict=True)) for key, column in columns.items()}
        return {"symmetry": asdict(self.symmetry), **named}

    @classmethod
    def of_record(cls, entries: Mapping[str, Any]) -> Axis:
        """Return the axis of entries of metrics.json, without its residual."""
        values, prior, posterior = (
            tuple(entries[key][name] for name in NAMES) for key in ("values", "prior_sigma", "posterior_sigma")
        )
        return cls(Symmetry.from_entries(entries["symmetry"]), values, prior, posterior, math.nan)

    @property
    def sentences(self) -> list[str]:
        """Position and direction of the axis, and their changes by the refinement."""
        x, y, z = self.symmetry.point
        if not self.symmetry.axial:
            return [f"planar: constant along {_vector(self.symmetry.direction)}"]
        lines = [f"axis: through ({x:.3f}, {y:.3f}, {z:.3f}) mm"]
        for i, name in enumerate(NAMES):
            noun, unit, factor = (
                ("shift", "mm", 1.0) if name.startswith("shift") else ("tilt", "deg", math.degrees(1.0))
            )
            direction = _vector(self.symmetry.frame[i % 2])
            if self.constrained[i]:
                value, sigma = self.values[i] * factor, self.posterior_sigma[i] * factor
                lines.append(f"{noun} towards {direction}: {value:+.3g} +- {sigma:.2g} {unit}")
            elif self.prior_sigma[i]:
                lines.append(f"The {noun} towards {direction} cannot be determined; kept at its initial value")
        return lines


def _vector(v: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{x:.2f}" for x in v) + ")"
