"""A voxel grid within a larger periodic one, on which the equations of motion are solved by Fourier transforms."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from nerif.flow.frame_resampling import laplacian
from nerif.geometry import Grid

__all__ = ["PeriodicBox"]

AXES = (-3, -2, -1)
MIN_LAYERS = 2  # of voxels in a margin


class PeriodicBox:
    """A periodic grid around the box of the measurement, whose margins stand for the flow outside.

    Vectors are (3, z, y, x), along x, y, z. Spectra are those of real fields (`torch.fft.rfftn`).

    Parameters
    ----------
    grid : voxels in the box of the measurement, mm
    margin : width of the layer on each side, as a fraction of the edge of the box; 0: the box itself is periodic
    """

    fewest = (4, 4, 4)
    """Voxels of a film along z, y, x at least."""

    def __init__(self, grid: Grid, margin: float = 0.2) -> None:
        self.grid = grid
        self.shape = tuple(self._length(n, max(MIN_LAYERS, round(margin * n)) if margin > 0 else 0) for n in grid.shape)
        self.first = tuple((m - n) // 2 for m, n in zip(self.shape, grid.shape, strict=True))
        """Voxels before the box, along z, y, x."""
        self.spacing = grid.spacing[::-1]
        kz, ky, kx = (2 * math.pi * self._frequencies(axis) for axis in range(3))
        self.wave = torch.stack(torch.broadcast_tensors(kx[None, None], ky[None, :, None], kz[:, None, None]))
        """(3, z, y, x) wave vectors along x, y, z, 1/mm."""
        self.wave_square = self.wave.square().sum(dim=0)
        self.inverse_square = torch.where(self.wave_square > 0, 1 / self.wave_square.clamp_min(1e-30), 0.0)

    def _length(self, count: int, layers: int) -> int:
        """Voxels along an edge, with layers on each side."""
        from scipy.fft import next_fast_len

        return int(next_fast_len(count + 2 * layers, real=True)) if layers else count

    def _frequencies(self, axis: int) -> Tensor:
        frequencies = torch.fft.rfftfreq if axis == 2 else torch.fft.fftfreq
        return frequencies(self.shape[axis], self.spacing[axis])

    @cached_property
    def nodes(self) -> Float[Tensor, "n 3"]:
        """Indices x, y, z of all nodes."""
        z, y, x = torch.meshgrid(*(torch.arange(float(n)) for n in self.shape), indexing="ij")
        return torch.stack([x, y, z], dim=-1).reshape(-1, 3)

    @cached_property
    def _spline(self) -> Tensor:
        """Spectrum of the B-spline at the nodes."""
        kx, ky, kz = self.wave
        hz, hy, hx = self.spacing
        return (2 + torch.cos(kx * hx)) * (2 + torch.cos(ky * hy)) * (2 + torch.cos(kz * hz)) / 27

    def spectrum(self, values: Float[Tensor, "*c z y x"]) -> Complex[Tensor, "*c z y xr"]:
        """Return the spectrum of real fields."""
        return torch.fft.rfftn(values, dim=AXES)

    def values(self, spectrum: Complex[Tensor, "*c z y xr"]) -> Float[Tensor, "*c z y x"]:
        """Return the fields of a spectrum."""
        return torch.fft.irfftn(spectrum, s=self.shape, dim=AXES)

    def spline(self, spectrum: Complex[Tensor, "*c z y xr"]) -> Float[Tensor, "*c z y x"]:
        """Return the coefficients of the cubic splines through fields of a spectrum."""
        return self.values(spectrum / self._spline)

    def solenoidal(self, spectrum: Complex[Tensor, "3 z y xr"]) -> Complex[Tensor, "3 z y xr"]:
        """Return vectors without the gradient in them: those of divergence 0, and mean 0, that are nearest."""
        divergence = (self.wave * spectrum).sum(dim=0)
        return (spectrum - self.wave * (divergence * self.inverse_square)) * (self.wave_square > 0)

    def potential(self, spectrum: Complex[Tensor, "3 z y xr"]) -> Complex[Tensor, "z y xr"]:
        """Return the potential of the gradient in vectors, of mean 0: lap p = div v."""
        return (self.wave * spectrum).sum(dim=0) * (-1j * self.inverse_square)

    def filtered(
        self, spectrum: Complex[Tensor, "3 z y xr"], response: Callable[[Tensor], Tensor]
    ) -> Complex[Tensor, "3 z y xr"]:
        """Return vectors of which the eigenfunctions of the Laplacian are multiplied by a response.

        It is a function of k^2 in 1/mm^2: exp(-amount k^2) for diffusion, -k^2 for the Laplacian.
        """
        return spectrum * response(self.wave_square)

    def uniform(self, velocity: Float[Tensor, 3]) -> Complex[Tensor, "3 z y xr"]:
        """Return the spectrum of a uniform velocity."""
        return self.spectrum(velocity[:, None, None, None].expand(3, *self.shape))

    def velocity(self, vorticity: Float[Tensor, "3 z y x"]) -> Complex[Tensor, "3 z y xr"]:
        """Return the spectrum of the velocity of divergence 0, and mean 0, with a vorticity: u = curl w / k^2."""
        w = self.spectrum(vorticity) * (1j * self.inverse_square)
        kx, ky, kz = self.wave
        return torch.stack([ky * w[2] - kz * w[1], kz * w[0] - kx * w[2], kx * w[1] - ky * w[0]])

    def gradient(self, spectrum: Complex[Tensor, "z y xr"]) -> Float[Tensor, "3 z y x"]:
        """Return the gradient of a scalar, per mm."""
        return self.values(1j * self.wave * spectrum)

    def laplacian(self, values: Float[Tensor, "*c z y x"], grid: Grid) -> Float[Tensor, "*c z y x"]:
        """Return the Laplacian of scalars on a grid of the measurement, per mm^2."""
        return laplacian(values, grid.spacing[::-1])

    def noise_by_place(self, variance: Float[Tensor, "z y x"]) -> Tensor:
        """Return the part of a film's variance of noise that depends on the place, not on the change of density: 0."""
        return torch.zeros(())

    def white(self, shape: Sequence[int], odd: bool, generator: torch.Generator) -> Tensor:
        """Return white noise (..., z, y, x) of variance 1, with the symmetry of the flow (odd for vorticity)."""
        return torch.randn(*shape, generator=generator)

    def low_pass(self, wavelength: float) -> Float[Tensor, "z y xr"]:
        """Return the response (1 + (k L / 2 pi)^2)^-1 of L in mm, scaled so that white fields keep their variance."""
        response = 1 / (1 + self.wave_square * (wavelength / (2 * math.pi)) ** 2)
        twice = torch.full_like(response, 2.0)
        twice[..., 0] = 1  # the spectrum holds half of the waves
        if self.shape[2] % 2 == 0:
            twice[..., -1] = 1
        return response / ((twice * response.square()).sum() / math.prod(self.shape)).sqrt()

    def inside(self, values: Float[Tensor, "*c z y x"]) -> Float[Tensor, "*c z y x"]:
        """Return the part in the box of the measurement."""
        for axis, (first, count) in enumerate(zip(self.first, self.grid.shape, strict=True)):
            values = values.narrow(axis - 3, first, count)
        return values

    def extended(self, values: Float[Tensor, "*c z y x"]) -> Float[Tensor, "*c z y x"]:
        """Return fields in the box continued into the margins, across which they fall to 0."""
        pairs = [(f, m - n - f) for f, m, n in zip(self.first, self.shape, self.grid.shape, strict=True)]
        flat = values.reshape(-1, 1, *values.shape[-3:])
        before_after = [n for pair in pairs[::-1] for n in pair]
        padded = torch.nn.functional.pad(flat, before_after, mode="replicate").reshape(*values.shape[:-3], *self.shape)
        for axis in range(3):
            shape = [1, 1, 1]
            shape[axis] = -1
            padded = padded * self._taper(axis).reshape(shape)
        return padded

    def margins(self) -> Float[Tensor, "z y x"]:
        """Return 1 in the margins and 0 in the box."""
        outside = torch.ones(self.shape)
        self.inside(outside).zero_()
        return outside

    def _taper(self, axis: int) -> Tensor:
        """1 in the box, 0 in the middle of the periodic margin along an axis."""
        first, n, m = self.first[axis], self.grid.shape[axis], self.shape[axis]
        i = torch.arange(float(m))
        beyond = torch.maximum(first - i, i - (first + n - 1)).clamp_min(0)
        return torch.cos(0.5 * math.pi * (beyond / max((m - n) / 2, 1)).clamp_max(1)) ** 2
