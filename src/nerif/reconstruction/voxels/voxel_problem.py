"""The linear least-squares problem of the voxel methods on one grid, in numbers of order one.

    min_x  |F x - b|^2 + weight R(x),     F = (1/sigma) A scale / sqrt(N),   b = (1/sigma) y / sqrt(N), |b| = 1

x is the field over its scale, one coefficient per voxel; y holds the N measured values of all techniques. In the
penalties lengths are in units of the box (cube root of its volume) and sums over voxels are means, so that a weight
means the same on every grid. Voxels that are not free are ambient: x = 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.fields.voxel_field import Boundary
from nerif.geometry import Grid, Rays
from nerif.reconstruction.target import Target, TechniqueData
from nerif.reconstruction.voxels.operator import VoxelOperator

__all__ = [
    "Differences", "Iterate", "Penalty", "Problem", "conjugate_gradients", "filtered", "minimise", "response",
    "spectrum_of_differences",
]  # fmt: skip

ROUND_ITERATIONS = 10  # before the set of voxels at their bounds is updated
MAX_HALVINGS = 20  # of a step, beyond which it is below rounding
MIN_RESPONSE = 1e-2  # of the largest value of S, the spectrum of F^T F


@dataclass(frozen=True)
class Iterate:
    """The state after an iteration."""

    x: Tensor  # (z, y, x) scaled coefficients
    residual: float  # |F x - b|^2; 1 for the zero field
    penalty: float  # R(x)

    def objective(self, weight: float) -> float:
        """Return |F x - b|^2 + weight R(x)."""
        return self.residual + weight * self.penalty


class Differences:
    """The gradient of a voxel field in units of the box edge: differences between neighbours, and their adjoint.

    (D_x c)_i = (edge / h_x) (c_i - c_{i-1}),     at the n + 1 faces of the n voxels along x
    """

    def __init__(self, grid: Grid, boundary: Boundary) -> None:
        self.boundary, self.shape = boundary, grid.shape
        edge = math.prod(grid.box.edges) ** (1 / 3)
        hx, hy, hz = grid.spacing
        self.inverse = (edge / hz, edge / hy, edge / hx)

    def __call__(self, x: Float[Tensor, "z y x"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return the differences along z, y and x."""
        padded = self.boundary.extend(x, 1)
        z, y, x = (torch.diff(self._line(padded, axis), dim=axis) * self.inverse[axis] for axis in range(3))
        return z, y, x

    def adjoint(self, along: tuple[Tensor, Tensor, Tensor]) -> Float[Tensor, "z y x"]:
        """Return the adjoint of the differences (minus the divergence)."""
        padded = along[0].new_zeros([n + 2 for n in self.shape])
        for axis in range(3):
            inner, n = self._line(padded, axis), self.shape[axis] + 1
            inner.narrow(axis, 1, n).add_(along[axis], alpha=self.inverse[axis])
            inner.narrow(axis, 0, n).sub_(along[axis], alpha=self.inverse[axis])
        return self.boundary.fold(padded, 1)

    def _line(self, padded: Tensor, axis: int) -> Tensor:
        """The part of a padded field that extends beyond the box along one axis only."""
        for other in range(3):
            if other != axis:
                padded = padded.narrow(other, 1, self.shape[other])
        return padded


class Problem:
    """The data and the operators on one grid, one for each part of the target.

    `free` voxels are not ambient, None for all; `bounds` are the lowest and highest value of the field, or None;
    `pixels` is the problem of single pixels for a target of bins.
    """

    def __init__(
        self, operators: Sequence[VoxelOperator], target: Target, free: Bool[Tensor, "z y x"] | None = None,
        bounds: tuple[float, float] | None = None, pixels: Problem | None = None,
    ) -> None:  # fmt: skip
        self.operators, self.target, self.scale, self.pixels = tuple(operators), target, target.scale, pixels
        self.operator = operator = self.operators[0]
        self.differences = Differences(operator.grid, operator.boundary)
        self.voxels = math.prod(operator.grid.shape)
        self._free = None if free is None else free.to(operator.device, operator.dtype)
        root = math.sqrt(target.numbers)
        self._inverse = [(part.inverse_scale / root).to(operator.device, operator.dtype) for part in target.parts]
        self.data = _concatenated(
            [inverse * part.of_field.to(inverse) for inverse, part in zip(self._inverse, target.parts, strict=True)]
        )
        self.bounds = None if bounds is None else (bounds[0] / self.scale, bounds[1] / self.scale)

    def forward(self, x: Float[Tensor, "z y x"]) -> Float[Tensor, " n"]:
        """Return F x."""
        x = self.pin(x) * self.scale
        return _concatenated([a(x) * inverse for a, inverse in zip(self.operators, self._inverse, strict=True)])

    def adjoint(self, y: Float[Tensor, " n"]) -> Float[Tensor, "z y x"]:
        """Return F^T y."""
        parts = zip(self.operators, self._inverse, y.split([inverse.numel() for inverse in self._inverse]), strict=True)
        total = reduce(torch.add, (a.T(part.reshape(inverse.shape) * inverse) for a, inverse, part in parts))
        return self.pin(total * self.scale)

    def residual(self, x: Float[Tensor, "z y x"]) -> float:
        """Return |F x - b|^2."""
        return _square(self.data - self.forward(x))

    def pixel_residual(self, iterate: Iterate) -> float:
        """Return |F x - b|^2 of single pixels."""
        return iterate.residual if self.pixels is None else self.pixels.residual(iterate.x)

    @property
    def noise(self) -> float | None:
        """|F x - b|^2 of single pixels due to noise alone; None where sigma is not known."""
        return (self.pixels or self).target.noise

    def predict(self, part: TechniqueData, rays: Rays, x: Float[Tensor, "z y x"]) -> Float[Tensor, "n c"]:
        """Return the projections of x along other rays of the technique of a part."""
        parts = zip(self.operators, self.target.parts, strict=True)
        operator = next(operator for operator, p in parts if p.model.name == part.model.name)
        return operator.for_rays(rays, part.model)(x * self.scale)

    def matrix(
        self, apply: Callable[[Tensor], Tensor], on_voxel: Callable[[int, int], None] = lambda done, total: None
    ) -> Float[Tensor, "n m"]:
        """Return a linear operator on fields as a matrix, column by column, for small grids."""
        ones = torch.eye(self.voxels).to(self.zero()).reshape(-1, *self.operator.domain_shape)
        columns = torch.empty(apply(ones[0]).numel(), self.voxels, dtype=torch.float64)
        for i, one in enumerate(ones):
            columns[:, i] = apply(one).flatten()
            on_voxel(i + 1, self.voxels)
        return columns

    def pin(self, x: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """Return x with 0, the ambient index, in voxels that are not free."""
        return x if self._free is None else x * self._free

    def clip(self, x: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """Return x within the bounds and pinned."""
        return self.pin(x) if self.bounds is None else self.pin(x.clamp(*self.bounds))

    @cached_property
    def response(self) -> Float[Tensor, "z y k"]:
        """The approximate spectrum of F^T F."""
        free = None if self._free is None else self._free > 0
        return response(lambda x: self.adjoint(self.forward(x)), self.zero(), free)

    def random(self) -> Float[Tensor, "z y x"]:
        """Return a reproducible random field, the start of the power method."""
        x = torch.rand(self.operator.domain_shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        return self.pin(x.to(self.operator.device, self.operator.dtype))

    def zero(self) -> Float[Tensor, "z y x"]:
        """Return the ambient field."""
        return torch.zeros(self.operator.domain_shape, dtype=self.operator.dtype, device=self.operator.device)


class Penalty:
    """A quadratic penalty R(x) = |L x|^2, a mean over voxels.

    L = 1 ("identity"), edge grad ("gradient") or edge^2 div grad ("laplacian"); the squares of the gradient may have
    weights at the faces along z, y, x.
    """

    KINDS = ("identity", "gradient", "laplacian")

    def __init__(self, problem: Problem, kind: str, face_weights: tuple[Tensor, Tensor, Tensor] | None = None) -> None:
        self.problem, self.kind = problem, kind
        self.root = 1 / math.sqrt(problem.voxels)
        self.mean_weight, self.factors = 1.0, tuple[float | Tensor, ...]([self.root] * 3)
        if face_weights is not None:
            roots = [w.sqrt() for w in face_weights]
            self.mean_weight = float(torch.stack([r.square().mean() for r in roots]).mean())
            self.factors = tuple(r * self.root for r in roots)

    @cached_property
    def spectrum(self) -> Float[Tensor, "z y k"]:
        """The spectrum of L^T L; for face weights, that of their mean."""
        spectrum = spectrum_of_differences(self.problem.zero(), self.problem.differences.inverse)
        if self.kind == "identity":
            return torch.ones_like(spectrum) * self.root**2
        if self.kind == "laplacian":
            return (spectrum * self.root) ** 2
        return self.mean_weight * spectrum * self.root**2

    def __call__(self, x: Float[Tensor, "z y x"]) -> tuple[Tensor, ...]:
        """Return L x."""
        if self.kind == "identity":
            return (x * self.root,)
        along = self.problem.differences(x)
        if self.kind == "laplacian":
            return (self.problem.differences.adjoint(along) * self.root,)
        return tuple(a * factor for a, factor in zip(along, self.factors, strict=True))

    def adjoint(self, y: tuple[Tensor, ...]) -> Float[Tensor, "z y x"]:
        """Return L^T y."""
        if self.kind == "identity":
            return y[0] * self.root
        if self.kind == "laplacian":
            return self.problem.differences.adjoint(self.problem.differences(y[0] * self.root))
        along = tuple(a * factor for a, factor in zip(y, self.factors, strict=True))
        return self.problem.differences.adjoint((along[0], along[1], along[2]))

    def squares(self) -> Float[Tensor, "m m"]:
        """Return L^T L as a matrix, for small grids."""
        return self.problem.matrix(lambda x: self.adjoint(self(x)))


def minimise(problem: Problem, penalty: Penalty, weight: float, x: Tensor) -> Iterator[Iterate]:
    """Minimise |F x - b|^2 + weight |L x|^2 within the bounds, without end; no iterate is worse than the one before.

    Each round runs conjugate gradients with the voxels at their bounds fixed and projects the result onto the bounds.
    It ends after ROUND_ITERATIONS, or when the projection raises the objective; if the first step does, it is halved
    until the objective falls.

    Source: More & Toraldo, SIAM J. Optim. 1 (1991) 93, with a search along the path instead of one along a line.
    """
    x = problem.clip(x)
    if problem.bounds is None:
        yield from conjugate_gradients(problem, penalty, weight, x)
    best = _iterate_at(problem, penalty, x)
    while True:
        start = best
        solver = conjugate_gradients(problem, penalty, weight, best.x)
        for _, unbounded in zip(range(ROUND_ITERATIONS), solver, strict=False):
            x = problem.clip(unbounded.x)
            iterate = unbounded if torch.equal(x, unbounded.x) else _iterate_at(problem, penalty, x)
            if iterate.objective(weight) >= best.objective(weight):
                break
            best = iterate
            yield best
        step, halvings = unbounded.x - start.x, 0
        while best is start:
            step, halvings = step / 2, halvings + 1
            iterate = _iterate_at(problem, penalty, problem.clip(start.x + step))
            if iterate.objective(weight) < start.objective(weight):
                best = iterate
            if best is iterate or halvings > MAX_HALVINGS:
                yield best


def conjugate_gradients(problem: Problem, penalty: Penalty, weight: float, x: Tensor) -> Iterator[Iterate]:
    """Minimise |F x - b|^2 + weight |L x|^2 by conjugate gradients on the least-squares problem (CGLS), without end.

        alpha = s.z / (|F p|^2 + weight |L p|^2),         x <- x + alpha p,    r <- r - alpha F p
        s = F^T r - weight L^T L x,    z = M^-1 s,        p <- z + (s.z / s_last.z_last) p

    Voxels at a bound towards which the objective falls are fixed; the others are not clipped. M = S + weight T is the
    preconditioner, with T the spectrum of L^T L and S that of F^T F, which is nearly a convolution. It finds early the
    components that few views leave nearly undetermined: S is small for waves whose wave vector lies in none of the
    image planes, so it must not be averaged over directions.

    Source: Bjorck, Numerical Methods for Least Squares Problems (SIAM, 1996), Sec. 7.4; with circulant M: Chan & Ng,
    SIAM Review 38 (1996) 427.
    """
    r = problem.data - problem.forward(x)
    q = tuple(-a for a in penalty(x))
    s = problem.pin(problem.adjoint(r) + weight * penalty.adjoint(q))
    movable = torch.ones_like(x)
    if problem.bounds is not None:
        low, high = problem.bounds
        movable = (~((x <= low) & (s < 0)) & ~((x >= high) & (s > 0))).to(x)
    s = s * movable
    spectrum = problem.response + weight * penalty.spectrum
    p = problem.pin(filtered(s, spectrum)) * movable
    gamma = float((s * p).sum())
    rounding = gamma * (100 * torch.finfo(x.dtype).eps) ** 2
    while True:
        if gamma > rounding:
            fp, lp = problem.forward(p), penalty(p)
            alpha = gamma / (_square(fp) + weight * sum(_square(a) for a in lp))
            x = x + alpha * p
            r = r - alpha * fp
            q = tuple(a - alpha * b for a, b in zip(q, lp, strict=True))
        yield Iterate(x, _square(r), sum(_square(a) for a in q))
        if gamma > rounding:
            s = problem.pin(problem.adjoint(r) + weight * penalty.adjoint(q)) * movable
            z = problem.pin(filtered(s, spectrum)) * movable
            last, gamma = gamma, float((s * z).sum())
            p = z + (gamma / last) * p


def _iterate_at(problem: Problem, penalty: Penalty, x: Tensor) -> Iterate:
    return Iterate(x, problem.residual(x), sum(_square(a) for a in penalty(x)))


def _square(x: Tensor) -> float:
    return float(x.square().sum())


def _concatenated(parts: list[Tensor]) -> Float[Tensor, " n"]:
    return parts[0].reshape(-1) if len(parts) == 1 else torch.cat([part.reshape(-1) for part in parts])


def response(
    normal: Callable[[Tensor], Tensor], empty: Float[Tensor, "z y x"], free: Bool[Tensor, "z y x"] | None
) -> Float[Tensor, "z y k"]:
    """Return S, from the response of F^T F (`normal`) to the free voxel nearest to the middle."""
    lines = [torch.arange(n, device=empty.device) - n // 2 for n in empty.shape]
    distance = sum(a**2 for a in torch.meshgrid(*lines, indexing="ij"))
    assert isinstance(distance, Tensor)
    if free is not None:
        distance = torch.where(free.to(distance.device), distance, distance.max() + 1)
    at = torch.unravel_index(distance.argmin(), empty.shape)
    point = empty.clone()
    point[at] = 1
    spectrum = torch.fft.rfftn(normal(point).roll([-int(i) for i in at], (0, 1, 2))).real
    largest = float(spectrum.max())
    return spectrum.clamp_min(MIN_RESPONSE * largest) if largest > 0 else torch.ones_like(spectrum)


def spectrum_of_differences(x: Float[Tensor, "z y x"], inverse: Sequence[float]) -> Float[Tensor, "z y k"]:
    """Return the spectrum of squared differences between neighbours of x, sum_axis (2 - 2 cos k) inverse^2."""
    last = torch.fft.rfftfreq(x.shape[2], dtype=torch.float64)
    waves = [*(torch.fft.fftfreq(n, dtype=torch.float64) for n in x.shape[:2]), last]
    along = [i**2 * (2 - 2 * torch.cos(2 * math.pi * k)) for i, k in zip(inverse, waves, strict=True)]
    return (along[0][:, None, None] + along[1][:, None] + along[2]).to(x)


def filtered(x: Float[Tensor, "z y x"], spectrum: Float[Tensor, "z y k"]) -> Float[Tensor, "z y x"]:
    """Return x with its spectrum divided by another."""
    return torch.fft.irfftn(torch.fft.rfftn(x) / spectrum, s=x.shape)
