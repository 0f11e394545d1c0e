"""The plane through the axis of an axisymmetric flow, as a periodic box one voxel thick.

x is the distance from the axis, of either sign, and z lies along it. Scalars and w are even in x, u and the vorticity
about the axis are odd. Derivatives along r and z are those of a plane. The divergence and the Laplacian are diagonal in

    u = sum a_mn J1(k_m r) exp(i k_n z),      w = sum b_mn J0(k_m r) exp(i k_n z),      J1(k_m R) = 0

R is half the length along x, where u = 0.

Source: Batchelor, An introduction to fluid dynamics (1967), appendix 2 (operators in cylindrical coordinates).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.flow.periodic_box import PeriodicBox
from nerif.geometry import Grid

__all__ = ["AxisymmetricBox"]

ODD, EVEN = 0, 1


class AxisymmetricBox(PeriodicBox):
    """A periodic box of shape (z, 1, x) about the axis x = 0.

    Parameters
    ----------
    grid : one voxel along y, the axis in the middle along x; an odd number there is made even
    margin : as for PeriodicBox
    """

    fewest = (4, 1, 4)

    def __init__(self, grid: Grid, margin: float = 0.2) -> None:
        from scipy.special import j0, j1, jn_zeros

        (nz, ny, nx), low, high = grid.shape, grid.box.lower[0], grid.box.upper[0]
        if ny != 1 or abs(low + high) > 1e-6 * high:
            raise InputError(
                f"expected one voxel along y, and x from -r to r, got {ny} voxels, and {low:g} to {high:g} mm",
                field="grid",
            )
        super().__init__(Grid(grid.box, (nz, ny, nx + nx % 2)), margin)
        nodes, spacing = self.shape[2] // 2, self.spacing[2]
        r = (torch.arange(nodes, dtype=torch.float64) + 0.5) * spacing
        waves = torch.tensor([0.0, *jn_zeros(1, nodes - 1)], dtype=torch.float64) / (nodes * spacing)
        phase = (r[:, None] * waves).numpy()
        series = torch.from_numpy(j1(phase)), torch.from_numpy(j0(phase))
        self._series = tuple(matrix.float() for matrix in series)
        self._analysis = tuple(torch.linalg.pinv(matrix).float() for matrix in series)
        kz = 2 * math.pi * torch.fft.rfftfreq(self.shape[0], self.spacing[0])
        self._kr, self._kz = waves.float(), kz[:, None, None]
        square = self._kr**2 + self._kz**2
        self._square = square
        self._waves = torch.ones(len(kz), 1, 1)
        if self.shape[0] % 2 == 0:
            self._waves[-1] = 0  # of the shortest wave along z real fields have no derivative
        self._inverse = torch.where(square > 0, 1 / square.clamp_min(1e-30), 0.0)

    def _length(self, count: int, layers: int) -> int:
        length = super()._length(count, layers) if count > 1 else count
        return length + length % 2 if count > 1 else length

    def solenoidal(self, spectrum: Complex[Tensor, "3 z y xr"]) -> Complex[Tensor, "3 z y xr"]:
        a, b = self._coefficients(spectrum)
        divergence = (self._kr * a + 1j * self._kz * b) * self._inverse
        return self._vectors(a - self._kr * divergence, (b + 1j * self._kz * divergence) * (self._square > 0))

    def potential(self, spectrum: Complex[Tensor, "3 z y xr"]) -> Complex[Tensor, "z y xr"]:
        a, b = self._coefficients(spectrum)
        return self.spectrum(self._plane(-(self._kr * a + 1j * self._kz * b) * self._inverse, EVEN))

    def filtered(
        self, spectrum: Complex[Tensor, "3 z y xr"], response: Callable[[Tensor], Tensor]
    ) -> Complex[Tensor, "3 z y xr"]:
        gain = response(self._square)
        a, b = self._coefficients(spectrum)
        return self._vectors(a * gain, b * gain)

    def uniform(self, velocity: Float[Tensor, 3]) -> Complex[Tensor, "3 z y xr"]:
        return super().uniform(velocity * torch.tensor([0.0, 0.0, 1.0]))  # along the axis

    def velocity(self, vorticity: Float[Tensor, "3 z y x"]) -> Complex[Tensor, "3 z y xr"]:
        stream = self._series_of(vorticity[1], ODD) * self._inverse  # of J1: u = curl(stream e_phi)
        return self._vectors(-1j * self._kz * stream, self._kr * stream)

    def laplacian(self, values: Float[Tensor, "*c z y x"], grid: Grid) -> Float[Tensor, "*c z y x"]:
        if grid.shape[2] % 2:
            raise InputError(f"expected an even number of voxels along x, got {grid.shape[2]}", field="grid")
        r = grid.axis("x", torch.float32)
        slope = torch.gradient(values, spacing=grid.spacing[0], dim=-1)[0]
        return super().laplacian(values, grid) + slope / r

    def noise_by_place(self, variance: Float[Tensor, "z 1 x"]) -> Float[Tensor, "1 1 x"]:
        """Return the part of a film's variance of noise that depends on the distance from the axis: all of it.

        Its mean over the voxels that have a variance.
        """
        both = variance + variance.flip(-1)
        count = ((variance != 0).float() + (variance.flip(-1) != 0).float()).sum(dim=(0, 1), keepdim=True)
        return (both.sum(dim=(0, 1), keepdim=True) / count.clamp_min(1)).clamp_min(0)

    def white(self, shape: Sequence[int], odd: bool, generator: torch.Generator) -> Tensor:
        half = super().white((*shape[:-1], shape[-1] // 2), odd, generator)
        return torch.cat([(-1 if odd else 1) * half.flip(-1), half], dim=-1)

    def _coefficients(self, spectrum: Tensor) -> tuple[Tensor, Tensor]:
        """a and b of vectors."""
        values = self.values(spectrum)
        return self._series_of(values[0], ODD), self._series_of(values[2], EVEN)

    def _vectors(self, a: Tensor, b: Tensor) -> Tensor:
        """Spectrum of vectors of coefficients a and b."""
        u, w = self._plane(a, ODD), self._plane(b, EVEN)
        return self.spectrum(torch.stack([u, torch.zeros_like(u), w]))

    def _series_of(self, values: Float[Tensor, "*c z 1 x"], parity: int) -> Complex[Tensor, "*c zr 1 m"]:
        """Coefficients of the odd (J1) or even (J0) part of a field."""
        left, right = values.tensor_split(2, dim=-1)
        half = 0.5 * (right + (1 if parity == EVEN else -1) * left.flip(-1))
        return torch.fft.rfft(half @ self._analysis[parity].T, dim=-3) * self._waves

    def _plane(self, coefficients: Complex[Tensor, "*c zr 1 m"], parity: int) -> Float[Tensor, "*c z 1 x"]:
        """Field of coefficients."""
        half = torch.fft.irfft(coefficients, n=self.shape[0], dim=-3) @ self._series[parity].T
        return torch.cat([(1 if parity == EVEN else -1) * half.flip(-1), half], dim=-1)
