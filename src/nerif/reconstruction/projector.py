"""The forward projector of a measurement and its adjoint, for algorithms of your own (docs/projector.md)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.axis_order import order_remedy
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.field import Field
from nerif.fields.voxel_field import spline_coefficients
from nerif.forward.model_names import AUTO
from nerif.geometry import Grid
from nerif.reconstruction.aperture import apply_aperture
from nerif.reconstruction.device import resolve_device
from nerif.reconstruction.gauge import ambient_faces as faces_of
from nerif.reconstruction.sources import of_source
from nerif.reconstruction.target import Target
from nerif.reconstruction.voxels.layout import InSpace
from nerif.reconstruction.voxels.operator import operator_norm

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator

__all__ = ["Projector"]

VOLUME, IMAGES = ("z", "y", "x"), ("view", "row", "column", "channel")


class Projector:
    """The linear map from a volume to the pixels of a measurement: `A(x)`, its exact adjoint `A.T(y)`, its data.

        y = A x,      <A x, y> = <x, A^T y>

    x (z, y, x) are the coefficients of a B-spline on the grid, in the unit of the field: of n - n_ambient (1), or
    1/mm. Of a linear basis they are the values at the voxel centres; of a cubic one `volume` returns these from x,
    and `coefficients` x from these. y (view, row, column, channel) are the values of the measurement, in its units,
    the channels of one technique after those of another. At pixels without data `A(x)` and `data` are 0, and `A.T`
    ignores y. Both directions are differentiable to any order.

    Parameters
    ----------
    measurement : cameras, data and their noise
    grid : voxels; beyond its box the field is ambient
    basis : "cubic", or "linear" (less accurate, and slower to converge for displacements)
    ambient_faces : faces of the box on which the field is 0, as ("x-", "y+"); None: those of the measurement, if a
        technique needs them
    open_faces : faces through which flow leaves the box; pixels whose rays cross them have no data
    model : a linear forward model by name, or auto
    source : of displacements and images, the data: displacements, images, both, or auto (displacements)
    aperture : auto (with the lenses of the measurement), on, or off (thin rays)
    device, dtype : of x and y; inputs are converted

    Raises
    ------
    InputError
        For a model that is not linear, an unknown name, or a grid that no ray crosses.
    """

    def __init__(
        self, measurement: Measurement, grid: Grid, basis: str = "cubic", *,
        ambient_faces: tuple[str, ...] | None = None, open_faces: tuple[str, ...] = (), model: str = AUTO,
        source: str = "auto", aperture: str = "auto", device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:  # fmt: skip
        measurement = apply_aperture(of_source(measurement, source, preferred="displacements"), aperture)
        measurement = replace(measurement, box=grid.box, ambient_region=None)
        self.measurement, self.grid, self.dtype = measurement, grid, dtype
        self.device = resolve_device(str(device), dtype)
        faces = faces_of(measurement) if ambient_faces is None else ambient_faces
        self.layout = InSpace(box=grid.box, faces=faces, basis=basis, device=self.device, dtype=dtype)
        target = Target.of(measurement, open_faces, model=model, linear=True, single=True)
        self.operators = [self.layout.operator(part.rays, grid, part.model) for part in target.parts]
        self.channels = tuple(name for o in measurement.observations for name in o.components)
        self.domain_shape, self.range_shape = grid.shape, (*measurement.shape, len(self.channels))
        self._pixels: list[tuple[Tensor, ...]] = []
        self._channels: list[slice] = []
        first = 0
        for part in target.parts:
            column, row = part.rays.pixel.round().long().unbind(-1)
            self._pixels.append(tuple(i.to(self.device) for i in (part.rays.view.long(), row, column)))
            self._channels.append(slice(first, first := first + part.measured.shape[1]))
        self.data: Float[Tensor, "view row column channel"] = self._images([part.of_field for part in target.parts])
        """The measured values; 0 at pixels without data."""
        self.mask: Bool[Tensor, "view row column channel"] = self._images(
            [torch.ones_like(part.measured) for part in target.parts]
        ).bool()
        """Which values are data: of valid pixels whose rays cross the box."""
        self.sigma: Float[Tensor, "view row column channel"] | None = None
        """Standard deviation of the noise of the data, infinite at other pixels; None where it is unknown."""
        if target.sigma_known:
            unit = 1 / math.sqrt(target.chi_square)
            inverse = self._images([part.inverse_scale.double() / unit for part in target.parts])
            self.sigma = inverse.reciprocal()

    def __call__(self, x: Float[Tensor, "z y x"]) -> Float[Tensor, "view row column channel"]:
        """Return the projections of a volume."""
        return _Linear.apply(self._tensor(x, self.domain_shape, "x", VOLUME), self._project, self._back_project)

    def T(self, y: Float[Tensor, "view row column channel"]) -> Float[Tensor, "z y x"]:
        """Return the back-projection of images, by the adjoint."""
        return _Linear.apply(self._tensor(y, self.range_shape, "y", IMAGES), self._back_project, self._project)

    @cached_property
    def norm(self) -> float:
        """The largest singular value |A|, estimated from below by power iteration."""
        start = torch.rand(self.domain_shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        return operator_norm(self._project, self._back_project, start.to(self.device, self.dtype))

    def field(self, x: Float[Tensor, "z y x"]) -> Field:
        """Return the field of a volume x, as nerif.reproject and nerif.evaluate_volume take it."""
        return self.layout.field(self._tensor(x, self.domain_shape, "x", VOLUME), self.grid)

    def volume(self, x: Float[Tensor, "z y x"]) -> Volume:
        """Return the values of a volume x at the voxel centres, as nerif.export writes them."""
        values = self.field(x).sample(self.grid, self.device)
        return Volume.of(values, self.grid, self.measurement.quantity, self.measurement.n_ambient)

    def coefficients(self, values: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """Return the x of a field from its values at the voxel centres."""
        values = self._tensor(values, self.domain_shape, "values", VOLUME)
        return spline_coefficients(values, self.layout.degree, self.layout.boundary)

    def as_linear_operator(self) -> LinearOperator:
        """Return the operator on flat NumPy arrays, for scipy.sparse.linalg.lsmr and the like."""
        import numpy as np
        from scipy.sparse.linalg import LinearOperator

        def flat(apply: Callable[[Tensor], Tensor], shape: tuple[int, ...]) -> Callable[[Any], Any]:
            def product(v: np.ndarray) -> np.ndarray:
                value = torch.tensor(v).reshape(shape).to(self.device, self.dtype)
                return apply(value).flatten().double().cpu().numpy()

            return product

        shape = math.prod(self.range_shape), math.prod(self.domain_shape)
        project, back_project = flat(self._project, self.domain_shape), flat(self._back_project, self.range_shape)
        return LinearOperator(shape, matvec=project, rmatvec=back_project, dtype=np.float64)

    def _project(self, x: Float[Tensor, "z y x"]) -> Float[Tensor, "view row column channel"]:
        return self._images([a(x) for a in self.operators])

    def _back_project(self, y: Float[Tensor, "view row column channel"]) -> Float[Tensor, "z y x"]:
        parts = zip(self.operators, self._pixels, self._channels, strict=True)
        return reduce(torch.add, (a.T(y[pixels][:, channels]) for a, pixels, channels in parts))

    def _images(self, parts: list[Tensor]) -> Float[Tensor, "view row column channel"]:
        """Images of the values of rays by technique, 0 elsewhere."""
        images = torch.zeros(self.range_shape, dtype=self.dtype, device=self.device)
        for pixels, channels, values in zip(self._pixels, self._channels, parts, strict=True):
            images[..., channels][pixels] = values.to(self.device, self.dtype)
        return images

    def _tensor(self, value: Any, shape: tuple[int, ...], name: str, axes: tuple[str, ...]) -> Tensor:
        """The array as a tensor of this device and precision."""
        tensor = torch.as_tensor(value)
        if tuple(tensor.shape) != shape:
            remedy = order_remedy(name, axes, shape, tensor.shape)
            raise InputError(f"expected ({', '.join(axes)}) = {shape}, got {tuple(tensor.shape)}{remedy}", field=name)
        return tensor.to(self.device, self.dtype)


class _Linear(torch.autograd.Function):
    """A linear map whose derivative is its adjoint, and the other way round."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, apply: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor]) -> Tensor:
        ctx.pair = adjoint, apply
        return apply(x)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return _Linear.apply(gradient, *ctx.pair), None, None
