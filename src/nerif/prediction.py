"""What cameras would see of a field that is known."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import InputError
from nerif.fields.base import Field
from nerif.fields.grid import DEGREES, VoxelField
from nerif.fields.mlp import NeuralField
from nerif.geometry import Box, Camera, Grid, Rays
from nerif.measurement import Measurement
from nerif.physics.deflection import MODELS as STRAIGHT_MODELS
from nerif.physics.deflection import Deflection, ForwardModel, project
from nerif.physics.ray_tracing import CurvedRays
from nerif.reconstruction.operator import MODELS, DeflectionOperator
from nerif.reprojection import Accuracy, Reprojection

VOXEL_STEP = 0.25  # voxels between samples
SAMPLES = 80  # a ray; 0.06 % of the rms displacement of a network fitted to the flame
EXACT_WORK = {"cpu": 2.5e11, "cuda": 2.5e13}  # multiplications: ten seconds on two cores
VOXELS, BEYOND = 100, 3  # along the longest edge of the box, and beyond each face
SPARSE_STEP = 2.0  # voxels between samples of SampledViews: as near to the network as half a voxel
COMPARED = 1024  # pixels

__all__ = ["FORWARD_MODELS", "SampledViews", "predict", "predict_view", "reproject"]

FORWARD_MODELS = (*STRAIGHT_MODELS, "traced")


def predict_view(
    field: Field, camera: Camera, model: ForwardModel, box: Box, device: torch.device | str = "cpu"
) -> Float[Tensor, "row column 2"]:
    """Return the displacement (px) that a camera would see of a field; 0 where a ray misses the box."""
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(box).to(dtype=torch.float32)
    if not rays.crosses.any():
        return torch.zeros(*camera.image_size, 2)
    if isinstance(field, VoxelField) and isinstance(model, Deflection) and model.model in MODELS:
        return _through_voxels(field, rays, model, device).reshape(*camera.image_size, 2)
    return project(model, field, rays, device).reshape(*camera.image_size, 2)


def _through_voxels(
    field: VoxelField, rays: Rays, model: Deflection, device: torch.device | str
) -> Float[Tensor, "n 2"]:
    """What `project` gives, by the compiled operator: tens of times faster, and 1 / n to first order only."""
    basis = next(name for name, degree in DEGREES.items() if degree == field.degree)
    operator = DeflectionOperator(
        rays, field.grid, model.n_ambient, model.model, basis, step=VOXEL_STEP, device=device
    )  # fmt: skip
    return operator.through(field.coefficients).cpu()


def predict(
    field: Field,
    cameras: Sequence[Camera],
    box: Box,
    n_ambient: float,
    model: str = "lever_arm",
    samples: int = 200,
    on_view: Callable[[int, int], None] = lambda done, total: None,
) -> Measurement:
    """Return the measurement that cameras would make of a field, without noise.

    Parameters
    ----------
    field : of index excess over n_ambient
    box : outside of which the index is ambient, mm
    model : lever_arm, paraxial or curved, as a reconstruction has it, or traced: rays bent to every order
    samples : along a ray, or Runge-Kutta steps of a traced one
    on_view : told how many views are done, out of how many

    Raises
    ------
    InputError
        If there is no such model.
    """
    if model not in FORWARD_MODELS:
        raise InputError(f"model: expected one of {', '.join(FORWARD_MODELS)}, got '{model}'")
    forward = CurvedRays(samples, n_ambient) if model == "traced" else Deflection(model, samples, n_ambient)
    height, width = (max(c.image_size[i] for c in cameras) for i in (0, 1))
    displacement = torch.full((len(cameras), height, width, 2), float("nan"))
    for i, camera in enumerate(cameras):
        h, w = camera.image_size
        displacement[i, :h, :w] = predict_view(field, camera, forward, box)
        on_view(i + 1, len(cameras))
    return Measurement(cameras=tuple(cameras), displacement=displacement, box=box, n_ambient=n_ambient)


def reproject(
    field: Field,
    measurement: Measurement,
    held_out: Collection[str] = (),
    device: torch.device | str = "cpu",
    on_view: Callable[[int, int], None] = lambda done, total: None,
    model: str = "lever_arm",
) -> Reprojection:
    """Predict what every view of a measurement sees of a field; px.

    A network is integrated along every ray where that takes some seconds only. Of larger pictures it is sampled on
    voxels, and the views are interpolated between rays through those (`SampledViews`); how far that is from the
    integral through the network is measured on some pixels, and told as `accuracy`.

    Parameters
    ----------
    held_out : names of the views that the reconstruction has not seen
    on_view : told how many views are done, out of how many
    model : forward model that the field was reconstructed with
    """
    forward, cameras, box = Deflection(model, SAMPLES, measurement.n_ambient), measurement.cameras, measurement.box
    many = _work(field, cameras) > EXACT_WORK[torch.device(device).type]
    sampled = SampledViews.of(field, box, forward, device) if many else None
    predicted = torch.full_like(measurement.displacement, float("nan"))
    for i, camera in enumerate(cameras):
        height, width = camera.image_size
        if sampled:
            seen = measurement.sees_box[i, :height, :width, None]
            predicted[i, :height, :width] = sampled(camera).where(seen, torch.zeros(()))
        else:
            predicted[i, :height, :width] = predict_view(field, camera, forward, box, device)
        on_view(i + 1, len(cameras))
    accuracy = sampled.accuracy(cameras, predicted) if sampled else Accuracy()
    return Reprojection(measurement, predicted, tuple(held_out), accuracy)


def _work(field: Field, cameras: Sequence[Camera]) -> float:
    """Multiplications of the path integral through a network on every pixel; 0 for other fields."""
    if not isinstance(field, NeuralField):
        return 0.0
    weights = sum(p.numel() for p in field.network.parameters())
    return float(weights) * SAMPLES * sum(c.image_size[0] * c.image_size[1] for c in cameras)


@dataclass(frozen=True)
class SampledViews:
    """Views of a network by way of its values on voxels.

    The network is sampled on a grid that goes on beyond the box, so that the cubic spline through the values is right
    up to its faces. Rays of a lattice of pixels, about two a voxel, are integrated through the spline by the compiled
    operator, and the pixels between them are interpolated by bicubic splines. What bending adds (`curved`) is
    integrated through the network itself on a coarser lattice.

    Parameters
    ----------
    field : the network
    voxels : spline through its values
    box : where the rays are integrated, mm
    model : forward model
    device : where the network is evaluated
    """

    field: Field
    voxels: VoxelField
    box: Box
    model: Deflection
    device: torch.device | str = "cpu"

    @classmethod
    def of(cls, field: Field, box: Box, model: Deflection, device: torch.device | str = "cpu") -> SampledViews:
        """Sample a field."""
        inner = Grid.of_resolution(box, VOXELS)
        lower = tuple(a - BEYOND * h for a, h in zip(box.lower, inner.spacing, strict=True))
        upper = tuple(b + BEYOND * h for b, h in zip(box.upper, inner.spacing, strict=True))
        nz, ny, nx = (n + 2 * BEYOND for n in inner.shape)
        grid = Grid(Box((lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2])), (nz, ny, nx))
        return cls(field, VoxelField.through(field.sample(grid, device), grid), box, model, device)

    def __call__(self, camera: Camera) -> Float[Tensor, "row column 2"]:
        """Return the displacement (px) that a camera would see; of no meaning where a ray misses the box."""
        step = max(1, min(camera.image_size) // (2 * VOXELS))
        view = _interpolated(camera, self.box, step, self._straight)
        if self.model.model == "curved":
            view = view + _interpolated(camera, self.box, 8 * step, self._bending)
        return view

    def _straight(self, rays: Rays) -> Float[Tensor, "n 2"]:
        n_ambient, model = self.model.n_ambient, self.model.model
        operator = DeflectionOperator(
            rays, self.voxels.grid, n_ambient, model if model in MODELS else MODELS[0], "cubic", step=SPARSE_STEP
        )
        return operator.through(self.voxels.coefficients)

    def _bending(self, rays: Rays) -> Float[Tensor, "n 2"]:
        """What bent rays see more than straight ones."""
        models = (self.model, replace(self.model, model=MODELS[0]))
        bent, straight = (project(model, self.field, rays, self.device) for model in models)
        return bent - straight

    def accuracy(self, cameras: Sequence[Camera], predicted: Float[Tensor, "view row column 2"]) -> Accuracy:
        """Compare what was predicted with the path integral through the network, on pixels picked at random."""
        generator = torch.Generator().manual_seed(0)
        apart = []
        for camera, view in zip(cameras, predicted, strict=True):
            size = torch.tensor(camera.image_size[::-1])
            pixels = (torch.rand(-(-COMPARED // len(cameras)), 2, generator=generator) * size).long()
            rays = camera.rays(pixels.to(camera.intrinsics)).clip(self.box).to(dtype=torch.float32)
            exact = project(self.model, self.field, rays, self.device)
            apart.append((view[pixels[:, 1], pixels[:, 0]] - exact)[rays.crosses])
        difference = torch.cat(apart)
        how = f"a cubic spline through the network's values on {VOXELS} voxels along the longest edge of the box"
        return Accuracy(how, float(difference.square().mean().sqrt()), len(difference))


def _interpolated(
    camera: Camera, box: Box, step: int, see: Callable[[Rays], Float[Tensor, "n 2"]]
) -> Float[Tensor, "row column 2"]:
    """What `see` makes of rays, on every step-th row and column, and by bicubic splines between them."""
    from scipy.interpolate import make_interp_spline

    rows, columns = (torch.arange(0, n + step - 1, step).clamp(max=n - 1) for n in camera.image_size)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    pixels = torch.stack([u, v], dim=-1).reshape(-1, 2).to(camera.intrinsics)
    rays = camera.rays(pixels).clip(box).to(dtype=torch.float32)
    if not rays.crosses.any():
        return torch.zeros(*camera.image_size, 2)
    seen = see(rays).reshape(len(rows), len(columns), 2)
    if step == 1:
        return seen
    values = seen.double().numpy()
    for axis, (places, n) in enumerate(zip((rows, columns), camera.image_size, strict=True)):
        spline = make_interp_spline(places.numpy(), values, k=min(3, len(places) - 1), axis=axis)  # one row has one
        values = spline(torch.arange(n).numpy())
    return torch.from_numpy(values).float()
