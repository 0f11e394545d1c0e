"""Densities of a film that fit the displacements of all frames and are carried along by one flow.

    1/2 sum ((A c_k - d_k) / sigma)^2 + 1/2 sum (r_k / tau)^2 + 1/2 |z|^2,      c = c_film + a F^-1 [S F z]

c_k are spline coefficients of the index, A their displacements, d_k the measured ones; r is the residual of transport
(transport.py) on single voxels, z white, S a low-pass filter and a the local change of the index over a voxel. All is
linear in z: conjugate gradients.

Source: Hestenes & Stiefel, J. Res. Natl. Bur. Stand. 49 (1952) 409.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.flow.frame_resampling import smooth, squared_slope
from nerif.flow.interpolation import periodic_spline
from nerif.flow.periodic_box import PeriodicBox
from nerif.flow.transport import Path, Transport
from nerif.geometry import Grid
from nerif.reconstruction.projector import Projector

__all__ = ["FilmDensity"]

ITERATIONS = 20
LAYERS = 2  # of coefficients beyond a face
CORRELATION = 5.0  # voxels: wavelength below which changes are expected to be smaller
UNRESOLVED = 0.2  # of the local change of theta per interval, that transport leaves on single voxels
LEAST = 0.002  # of the largest theta, likewise
FLOOR = 0.02  # of the largest change over a voxel


class FilmDensity:
    """Densities of a film, to be improved by its velocities.

    Parameters
    ----------
    theta : -(rho - rho_0) / rho_0 of the film
    grid : its voxels
    projectors : of the measurement of every frame, on that grid
    n_ambient : index of the ambient fluid
    iterations : of each improvement
    """

    def __init__(
        self, theta: Float[Tensor, "t z y x"], grid: Grid, projectors: Sequence[Projector], n_ambient: float,
        iterations: int = ITERATIONS,
    ) -> None:  # fmt: skip
        self.projectors, self.scale, self.iterations = projectors, 1 - n_ambient, iterations
        values = self.scale * theta.float()
        self.start = torch.stack([p.coefficients(volume) for p, volume in zip(projectors, values, strict=True)])
        self.box = PeriodicBox(grid, 0.0)
        self.response = self.box.low_pass(CORRELATION * max(grid.spacing))
        slope = smooth(squared_slope(values, (1.0, 1.0, 1.0)), (2.0, 2.0, 2.0)).clamp_min(0).sqrt()
        self.amplitude = slope + FLOOR * slope.max()
        self.data = [torch.nan_to_num(projector.data) for projector in projectors]
        residuals = [
            (p(c) - d)[p.mask] for p, c, d in zip(projectors, self.start, self.data, strict=True) if p.sigma is None
        ]
        rms = torch.cat(residuals).square().mean().sqrt().clamp_min(1e-30) if residuals else torch.ones(())
        self.weights = [torch.where(p.mask, 1 / (rms if p.sigma is None else p.sigma), 0.0) for p in projectors]

    @property
    def inputs(self) -> list[Tensor]:
        """Displacements and weights, which identify it."""
        return [*self.data, *self.weights]

    def __call__(
        self, transport: Transport, splines: Float[Tensor, "t 3 zp yp xp"],
        on_iterate: Callable[[int, float], bool] = lambda iteration, misfit: False,
    ) -> Float[Tensor, "t z y x"]:  # fmt: skip
        """Return theta of the film, given its velocity.

        Parameters
        ----------
        transport : of the film as known so far
        splines : coefficients of the velocity, mm/s
        on_iterate : called with the number of an iteration and the rms of (A c - d) / sigma; returns whether to stop
        """
        paths, gains = transport.paths(splines), [self.scale * gain for gain in transport.gains]
        deviations = transport.unresolved(UNRESOLVED, LEAST)
        weights = [1 / (abs(self.scale) * d.reshape(-1)[path.place]) for d, path in zip(deviations, paths, strict=True)]
        count = sum(int((w > 0).sum()) for w in self.weights)

        def residuals(c: Tensor, inhomogeneous: float) -> tuple[list[Tensor], list[Tensor]]:
            """The two kinds of residuals over their standard deviations, without constants if given 0."""
            of_data = [
                (p(x) - inhomogeneous * d) * w
                for p, x, d, w in zip(self.projectors, c.unbind(), self.data, self.weights, strict=True)
            ]
            extended = [p.layout.boundary.extend(x, LAYERS)[None] for p, x in zip(self.projectors, c, strict=True)]
            of_transport = [
                self._carried(extended[k], extended[k + 1], path, inhomogeneous * gains[k]) * weights[k]
                for k, path in enumerate(paths)
            ]
            return of_data, of_transport

        def slope(z: Tensor, inhomogeneous: float) -> tuple[Tensor, list[Tensor]]:
            z = z.detach().requires_grad_()
            parts = residuals(inhomogeneous * self.start + self._change(z), inhomogeneous)
            squares = [part.square().sum() for kind in parts for part in kind]
            objective = 0.5 * (z.square().sum() + torch.stack(squares).sum())
            return torch.autograd.grad(objective, z)[0], [part.detach() for part in parts[0]]

        z = torch.zeros_like(self.start)
        gradient, of_data = slope(z, 1.0)
        r, p = -gradient, -gradient
        square = r.square().sum()
        for iteration in range(self.iterations):
            if not square > 0:
                break
            q, change = slope(p, 0.0)
            step = square / (p * q).sum()
            z, r = z + step * p, r - step * q
            of_data = [part + step * more for part, more in zip(of_data, change, strict=True)]
            before, square = square, r.square().sum()
            p = r + square / before * p
            misfit = math.sqrt(sum(float(part.square().sum()) for part in of_data) / max(count, 1))
            if on_iterate(iteration + 1, misfit):
                break
        coefficients = self.start + self._change(z)
        volumes = [p.volume(c).values for p, c in zip(self.projectors, coefficients, strict=True)]
        return torch.stack(volumes).float() / self.scale

    def _change(self, z: Tensor) -> Tensor:
        return self.amplitude * self.box.values(self.box.spectrum(z) * self.response)

    @staticmethod
    def _carried(before: Tensor, after: Tensor, path: Path, gain: Tensor) -> Tensor:
        end = periodic_spline(after, path.end)[0] - periodic_spline(before, path.start)[0]
        return end - gain[path.inside]
