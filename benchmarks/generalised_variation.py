"""Total generalised variation on voxels, a peer of the network and of total variation in `methods`.

    min_x,w  |F x - b|^2 + weight mean (|edge grad x - w| + length |edge sym grad w|),     |a| = sqrt(a^2 + softness^2)

By iteratively reweighted least squares like total_variation.py, x and w in one solution by conjugate gradients. The
preconditioner is the inverse of the 4 x 4 blocks of the normal equations in Fourier space, with the means of the
weights. w lies at the faces of x along each axis; at the last face it is 0.

Source: Bredies, Kunisch & Pock, SIAM J. Imaging Sci. 3 (2010) 492, second order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from nerif.common.settings import Count, Positive
from nerif.reconstruction.voxels.face_gradients import at_faces, gradient_square
from nerif.reconstruction.voxels.voxel_problem import Iterate, Problem
from nerif.reconstruction.voxels.voxel_reconstructor import WeightedVoxelReconstructor

__all__ = ["TotalGeneralisedVariation"]

PAIRS = ((0, 1), (0, 2), (1, 2))


@dataclass(frozen=True)
class TotalGeneralisedVariation(WeightedVoxelReconstructor):
    """Voxels with a penalty that is small for linear pieces with sharp fronts, without bounds of the field."""

    title: ClassVar[str] = "total generalised variation"
    length: Positive = 0.06
    """Weight of the second order, in box edges."""
    softness: Positive = 0.1
    """As of TotalVariation."""
    round: Count = 10
    """Conjugate-gradient iterations between new weights."""
    iterations: Count = 200
    """Maximum iterations on each grid and with each weight."""
    tolerance: float = 2e-5

    @property
    def patience(self) -> int:
        return self.round

    def iterate(self, problem: Problem, x: Tensor, weight: float) -> Iterator[Iterate]:
        u = torch.cat([x[None], _slope(problem, x)])
        while True:
            penalty = _Penalty(self, problem, u)
            inverse = penalty.inverse(weight)
            r = problem.data - problem.forward(u[0])
            q = [-a for a in penalty(u)]
            s = self._gradient(problem, penalty, weight, r, q)
            p = self._direction(problem, inverse, s)
            gamma = float((s * p).sum())
            for _ in range(self.round):
                fp, lp = problem.forward(p[0]), penalty(p)
                alpha = gamma / (_square(fp) + weight * sum(map(_square, lp)))
                u, r = u + alpha * p, r - alpha * fp
                q = [a - alpha * b for a, b in zip(q, lp, strict=True)]
                first, second = penalty.magnitudes(u)
                yield Iterate(u[0], _square(r), float(first.mean()) + self.length * float(second.mean()))
                s = self._gradient(problem, penalty, weight, r, q)
                z = self._direction(problem, inverse, s)
                last, gamma = gamma, float((s * z).sum())
                p = z + (gamma / last) * p

    @staticmethod
    def _gradient(problem: Problem, penalty: _Penalty, weight: float, r: Tensor, q: list[Tensor]) -> Tensor:
        s = weight * penalty.adjoint(q)
        s[0] = problem.pin(s[0] + problem.adjoint(r))
        return s

    @staticmethod
    def _direction(problem: Problem, inverse: Complex[Tensor, "z y k 4 4"], s: Tensor) -> Tensor:
        waves = torch.fft.rfftn(s, dim=(1, 2, 3))
        p = torch.fft.irfftn(torch.einsum("zykij,jzyk->izyk", inverse, waves), s=s.shape[1:], dim=(1, 2, 3))
        p[0] = problem.pin(p[0])
        return p


class _Penalty:
    """The quadratic form of a round, for u = (x, w_z, w_y, w_x)."""

    def __init__(self, settings: TotalGeneralisedVariation, problem: Problem, u: Float[Tensor, "4 z y x"]) -> None:
        self.settings, self.problem, self.inverses = settings, problem, problem.differences.inverse
        first, second = self.magnitudes(u)
        self.first = at_faces(0.5 / first / problem.voxels)
        self.second = 0.5 * settings.length / second / problem.voxels
        self.roots = [w.sqrt() for w in self.first], self.second.sqrt()

    def magnitudes(self, u: Tensor) -> tuple[Float[Tensor, "z y x"], Float[Tensor, "z y x"]]:
        softness, length = self.settings.softness, self.settings.length
        z, y, x = self._difference(u)
        second = sum(a.square() for a in self._symmetric(u[1:]))
        assert isinstance(second, Tensor)
        return (gradient_square((z, y, x)) + softness**2).sqrt(), (second + (softness / length) ** 2).sqrt()

    def __call__(self, u: Tensor) -> list[Tensor]:
        first = [a * root for a, root in zip(self._difference(u), self.roots[0], strict=True)]
        return first + [a * self.roots[1] for a in self._symmetric(u[1:])]

    def adjoint(self, q: list[Tensor]) -> Float[Tensor, "4 z y x"]:
        z, y, x = (a * root for a, root in zip(q[:3], self.roots[0], strict=True))
        second = [a * self.roots[1] for a in q[3:]]
        w = [
            self._forward_adjoint(second[a], a) - face.narrow(a, 0, face.shape[a] - 1)
            for a, face in enumerate((z, y, x))
        ]
        for (a, b), value in zip(PAIRS, second[3:], strict=True):
            w[a] = w[a] + self._backward_adjoint(value, b) / math.sqrt(2)
            w[b] = w[b] + self._backward_adjoint(value, a) / math.sqrt(2)
        return torch.stack([self.problem.differences.adjoint((z, y, x)), *w])

    def inverse(self, weight: float) -> Complex[Tensor, "z y k 4 4"]:
        """Return the inverse of the normal equations in Fourier space, with the means of the weights."""
        shape = self.problem.operator.domain_shape
        waves = [torch.fft.fftfreq(n, dtype=torch.float64) for n in shape[:2]]
        waves.append(torch.fft.rfftfreq(shape[2], dtype=torch.float64))
        along = [i * (1 - torch.exp(-2j * math.pi * k)) for i, k in zip(self.inverses, waves, strict=True)]
        d = torch.stack(torch.broadcast_tensors(along[0][:, None, None], along[1][:, None], along[2]), dim=-1)
        square = d.abs().square()
        first = weight * float(torch.stack([w.mean() for w in self.first]).mean())
        second = weight * float(self.second.mean())
        blocks = torch.zeros(*d.shape[:3], 4, 4, dtype=d.dtype)
        blocks[..., 0, 0] = self.problem.response + first * square.sum(dim=-1)
        blocks[..., 1:, 0], blocks[..., 0, 1:] = -first * d, -first * d.conj()
        blocks[..., 1:, 1:] = second * 0.5 * d.conj()[..., :, None] * d[..., None, :]
        for a in range(3):
            blocks[..., a + 1, a + 1] = first + second * 0.5 * (square.sum(dim=-1) + square[..., a])
        return torch.linalg.inv(blocks).to(self.problem.operator.dtype.to_complex())

    def _difference(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """grad x - w at the faces."""
        z, y, x = (g - _with_last(u[a + 1], a) for a, g in enumerate(self.problem.differences(u[0])))
        return z, y, x

    def _symmetric(self, w: Tensor) -> list[Tensor]:
        """The symmetric gradient of w: along the axes, and of pairs of axes times the root of 2."""
        along = [torch.diff(_with_last(w[a], a), dim=a) * self.inverses[a] for a in range(3)]
        return along + [(self._backward(w[a], b) + self._backward(w[b], a)) / math.sqrt(2) for a, b in PAIRS]

    def _forward_adjoint(self, y: Tensor, axis: int) -> Tensor:
        n = y.shape[axis] - 1
        result = -y
        result.narrow(axis, 1, n).add_(y.narrow(axis, 0, n))
        return result * self.inverses[axis]

    def _backward(self, w: Tensor, axis: int) -> Tensor:
        first = torch.zeros_like(w.narrow(axis, 0, 1))
        return torch.cat([first, torch.diff(w, dim=axis) * self.inverses[axis]], dim=axis)

    def _backward_adjoint(self, y: Tensor, axis: int) -> Tensor:
        n, result = y.shape[axis] - 1, torch.zeros_like(y)
        inner = y.narrow(axis, 1, n) * self.inverses[axis]
        result.narrow(axis, 1, n).add_(inner)
        result.narrow(axis, 0, n).sub_(inner)
        return result


def _with_last(w: Float[Tensor, "z y x"], axis: int) -> Tensor:
    return torch.cat([w, torch.zeros_like(w.narrow(axis, 0, 1))], dim=axis)


def _slope(problem: Problem, x: Float[Tensor, "z y x"]) -> Float[Tensor, "3 z y x"]:
    """The gradient of x at all faces but the last."""
    return torch.stack([g.narrow(a, 0, g.shape[a] - 1) for a, g in enumerate(problem.differences(x))])


def _square(a: Tensor) -> float:
    return float(a.square().sum())
