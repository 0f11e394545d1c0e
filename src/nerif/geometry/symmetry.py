"""Axisymmetric, nearly axisymmetric and planar fields: coordinates in which the field is constant.

With w = F (x - p), F the frame (rows e1, e2, e3) and p a point,

    axis      (r, h) = (sqrt(w1^2 + w2^2 + d^2), w3)     e3 along the axis through p, d a length that rounds it
    planar    (r, h) = (w1, w3)                           e2 along the direction in which the field is constant

A nearly axisymmetric field has N azimuthal harmonics as well: with u = (w1 + i w2) / r,

    f(x) = sum_k D_k(u) f_k(r, h),     D_k = (1 + 2 sum_m Re(u^m exp(-i m a_k))) / K,    a_k = 2 pi k / K,   K = 2 N + 1

f_k is the field at the azimuth a_k; on the axis only the mean remains.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import FACES, InputError, Points, Vectors
from nerif.geometry.grid import Box

__all__ = ["NAMES", "NO_SYMMETRY", "Axis", "Symmetry", "parse_symmetry"]

TOLD = 0.5  # of a standard deviation beforehand, below which the data tell a number
NAMES = ("shift_1", "shift_2", "lean_1", "lean_2")
"""Shifts (mm) along e1 and e2 of the frame, leans (rad) towards them."""


@dataclass(frozen=True)
class Axis:
    """An axis that was found.

    Parameters
    ----------
    symmetry : about it
    values, sigma, sigma_after : of NAMES, against the axis as named; sigma 0 for what was held
    residual : rms over sigma of what the coarse field leaves (over the rms measured, where sigma is not known)
    """

    symmetry: Symmetry
    values: tuple[float, ...]
    sigma: tuple[float, ...]
    sigma_after: tuple[float, ...]
    residual: float

    @property
    def told(self) -> tuple[bool, ...]:
        """Whether the data tell each of the numbers."""
        return tuple(b > 0 and a < TOLD * b for a, b in zip(self.sigma_after, self.sigma, strict=True))

    @property
    def record(self) -> dict[str, Any]:
        """What the metrics of a result hold of it."""
        named = {
            "values": dict(zip(NAMES, self.values, strict=True)),
            "sigma": dict(zip(NAMES, self.sigma, strict=True)),
            "sigma_after": dict(zip(NAMES, self.sigma_after, strict=True)),
            "told": dict(zip(NAMES, self.told, strict=True)),
        }
        return {"symmetry": asdict(self.symmetry), **named}

    @property
    def sentences(self) -> list[str]:
        """What to say of it."""
        x, y, z = self.symmetry.point
        if not self.symmetry.axial:
            along = ", ".join(f"{v:.2f}" for v in self.symmetry.direction)
            return [f"planar: alike along ({along})"]
        found = []
        for i, unit in enumerate(("mm", "mm", "deg", "deg")):
            if not self.sigma[i]:
                continue
            factor = 1.0 if unit == "mm" else math.degrees(1.0)
            kind = ("shifted by", "leaning by")[i // 2]
            e = self.symmetry.frame[i % 2]
            toward = "(" + ", ".join(f"{v:.2f}" for v in e) + ")"
            if self.told[i]:
                found.append(
                    f"{kind} {self.values[i] * factor:+.3g} +- {self.sigma_after[i] * factor:.2g} {unit} to {toward}"
                )
            else:
                found.append(f"what the views do not tell is as given: {kind.split()[0]} to {toward}")
        return [f"axis: through ({x:.3f}, {y:.3f}, {z:.3f}) mm", *found]


NO_SYMMETRY = "none"
MOST_HARMONICS = 8
ALONG = math.cos(math.radians(45))  # of a face's normal and a direction, from which the face lies across it


def parse_symmetry(text: str) -> tuple[str, int] | None:
    """Return the kind of a symmetry and its harmonics; None for none.

    Raises
    ------
    InputError
        If it is not none, axis, axis+N or planar.
    """
    if text == NO_SYMMETRY:
        return None
    found = re.fullmatch(r"(planar)|axis(?:\+(\d+))?", text)
    if not found or int(found[2] or 0) > MOST_HARMONICS:
        raise InputError(
            f"expected {NO_SYMMETRY}, axis, axis+N (N harmonics of the angle, at most {MOST_HARMONICS}) or "
            f"planar, got '{text}'",
            field="symmetry",
        )
    return found[1] or "axis", int(found[2] or 0)


@dataclass(frozen=True)
class Symmetry:
    """Which places have the same value.

    Parameters
    ----------
    kind : axis, or planar
    point : of the axis, mm; of a planar field any
    frame : (e1, e2, e3), unit vectors at right angles; e3 along the axis, or e2 along the line
    rounding : d, mm, at least a millionth of what is looked at
    harmonics : N, of the angle around an axis
    """

    kind: str
    point: tuple[float, float, float]
    frame: tuple[tuple[float, float, float], ...]
    rounding: float
    harmonics: int = 0

    @classmethod
    def about(
        cls, text: str, point: tuple[float, float, float], direction: tuple[float, float, float], rounding: float
    ) -> Symmetry | None:
        """Return the symmetry of a name about a line through a point (mm) in a direction of any length."""
        parsed = parse_symmetry(text)
        if parsed is None:
            return None
        kind, harmonics = parsed
        line = torch.tensor(direction, dtype=torch.float64)
        if not float(line.norm()) > 0:
            raise InputError(f"expected a direction (x, y, z), got {direction}", field="axis_direction")
        line = line / line.norm()
        # e1 as near as may be to the first coordinate that is not along the line
        first = torch.eye(3, dtype=torch.float64)[1 if abs(float(line[0])) > ALONG else 0]
        e1 = first - (first @ line) * line
        e1 = e1 / e1.norm()
        rows = (e1, torch.linalg.cross(line, e1), line)
        if kind == "planar":
            rows = (e1, line, torch.linalg.cross(e1, line))
        frame = tuple((float(a), float(b), float(c)) for a, b, c in (row.tolist() for row in rows))
        return cls(kind, point, frame, rounding, harmonics)

    @classmethod
    def kept(cls, plain: Mapping[str, Any]) -> Symmetry:
        """Return what a file keeps of one (dataclasses.asdict)."""
        x, y, z = plain["point"]
        frame = tuple((a, b, c) for a, b, c in plain["frame"])
        return cls(plain["kind"], (x, y, z), frame, float(plain["rounding"]), int(plain["harmonics"]))

    @property
    def axial(self) -> bool:
        """Whether it is about an axis."""
        return self.kind == "axis"

    @property
    def angles(self) -> int:
        """K, numbers that the field has at a place (r, h)."""
        return 2 * self.harmonics + 1

    @property
    def direction(self) -> tuple[float, float, float]:
        """Unit vector along the axis, or along the line on which nothing changes."""
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
        """Return (r, 0, h) of places in the frame."""
        x, y, h = w.unbind(-1)
        r = (x * x + y * y + self.rounding**2).sqrt() if self.axial else x
        return torch.stack([r, torch.zeros_like(r), h], dim=-1)

    def turned_back(self, w: Points, slope: Vectors) -> Vectors:
        """Return the gradient in space of a field whose slopes along (r, -, h) are given, at places in the frame."""
        if self.axial:
            r = (w[..., 0].square() + w[..., 1].square() + self.rounding**2).sqrt()
            along = torch.stack([slope[..., 0] * w[..., 0] / r, slope[..., 0] * w[..., 1] / r, slope[..., 2]], dim=-1)
        else:
            along = torch.stack([slope[..., 0], torch.zeros_like(slope[..., 0]), slope[..., 2]], dim=-1)
        return self._in_space(along)

    def shares(self, w: Points) -> tuple[Float[Tensor, "*n k"], Float[Tensor, "*n k 3"]]:
        """Return D_k at places in the frame, and its gradient in space, 1/mm."""
        count = self.angles
        share = torch.ones(*w.shape[:-1], count, dtype=w.dtype, device=w.device)
        slope = torch.zeros(*share.shape, 3, dtype=w.dtype, device=w.device)
        x, y = w[..., 0], w[..., 1]
        r = (x * x + y * y + self.rounding**2).sqrt()
        u = torch.complex(x, y) / r
        toward = torch.stack([x, y], dim=-1) / r[..., None]  # of r
        one = torch.tensor([1, 1j], dtype=u.dtype, device=w.device)
        turn = (one - u[..., None] * toward) / r[..., None]  # of u
        angle = 2 * math.pi * torch.arange(count, dtype=w.dtype, device=w.device) / count
        power = torch.ones_like(u)
        for m in range(1, self.harmonics + 1):
            phase = torch.polar(torch.ones_like(angle), -m * angle)
            rise = (m * power)[..., None] * turn
            slope[..., :2] += 2 * (rise[..., None, :] * phase[:, None]).real
            power = power * u
            share = share + 2 * (power[..., None] * phase).real
        return share / count, self._in_space(slope / count)

    def _in_space(self, along: Vectors) -> Vectors:
        """Components along x, y, z of vectors given along e1, e2, e3."""
        return torch.stack([(along * column).sum(-1) for column in self.matrix.to(along).T], dim=-1)

    def places(self, r: Tensor, angle: Tensor, h: Tensor) -> Points:
        """Return points (mm) at (r, h) and an angle around the axis, rad; on the plane through p where it is planar."""
        w = torch.stack([r * angle.cos(), r * angle.sin(), h], dim=-1)
        if not self.axial:
            w = torch.stack([r, torch.zeros_like(r), h], dim=-1)
        return w.new_tensor(self.point) + self._in_space(w)

    def moved(self, shift: tuple[float, float], turn: tuple[float, float]) -> Symmetry:
        """Return it shifted along e1 and e2 (mm) and leant towards them (rad)."""
        frame = self.matrix
        e3 = frame[2] + turn[0] * frame[0] + turn[1] * frame[1]
        e3 = e3 / e3.norm()
        e1 = frame[0] - (frame[0] @ e3) * e3
        e1 = e1 / e1.norm()
        rows = torch.stack([e1, torch.linalg.cross(e3, e1), e3]).tolist()
        point = torch.tensor(self.point, dtype=torch.float64) + shift[0] * frame[0] + shift[1] * frame[1]
        x, y, z = point.tolist()
        return replace(self, point=(x, y, z), frame=tuple((a, b, c) for a, b, c in rows))

    def near(self, other: Symmetry, apart: float) -> bool:
        """Return whether another is of the same kind about nearly the same axis.

        Parameters
        ----------
        apart : largest difference of its coordinates, in their unit, and of the directions
        """
        mine, others = ((*s.point, *(x for row in s.frame for x in row)) for s in (self, other))
        same = (self.kind, self.harmonics) == (other.kind, other.harmonics)
        return same and all(abs(a - b) <= apart for a, b in zip(mine, others, strict=True))

    def in_units(self, centre: tuple[float, float, float], unit: float) -> Symmetry:
        """Return it in coordinates (x - centre) / unit."""
        x, y, z = ((p - c) / unit for p, c in zip(self.point, centre, strict=True))
        return replace(self, point=(x, y, z), rounding=self.rounding / unit)

    def faces(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the faces of (r, -, h) that faces of a box stand for: x+ for those around an axis, z- and z+."""
        found = []
        for name in names:
            normal = self.matrix[:, FACES.index(name) // 2] * (1 if name[1] == "+" else -1)
            if self.axial:
                found.append("x+" if abs(normal[2]) < ALONG else f"z{'+' if normal[2] > 0 else '-'}")
            elif abs(normal[1]) < ALONG:
                row = 0 if abs(normal[0]) >= ALONG else 2
                found.append("xyz"[row] + ("+" if normal[row] > 0 else "-"))
        return tuple(dict.fromkeys(found))

    def reduced_box(self, box: Box, ambient: tuple[str, ...]) -> Box:
        """Return the box of (r, -, h) that a box in space fills; about an axis no wider than to an ambient face.

        Parameters
        ----------
        box : Box, mm
        ambient : its faces on which the field is ambient, beyond which nothing is looked for
        """
        unit = torch.cartesian_prod(*[torch.tensor([0.0, 1.0], dtype=torch.float64)] * 3)
        w = self.local(torch.tensor(box.lower, dtype=torch.float64) + unit * torch.tensor(box.edges))
        low, high = w.amin(dim=0).tolist(), w.amax(dim=0).tolist()
        if self.axial:
            low[0], high[0] = 0.0, float(w[:, :2].norm(dim=1).max())
            for name in ambient:
                axis, sign = FACES.index(name) // 2, 1 if name[1] == "+" else -1
                if abs(float(self.matrix[2, axis])) < ALONG:
                    face = box.upper[axis] if sign > 0 else box.lower[axis]
                    high[0] = min(high[0], sign * (face - self.point[axis]))
            if not high[0] > 0:
                raise InputError(f"expected the axis within the box, got {self.point} mm", field="axis_point")
        width = (high[0] - low[0]) / 2
        return Box((low[0], -width, low[2]), (high[0], width, high[2]))
