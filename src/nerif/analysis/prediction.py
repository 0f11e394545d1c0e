"""Predicted measurements of a field by given cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.pauses import pause
from nerif.data.measurement import Measurement, measurement_of
from nerif.data.quantity_names import name_of
from nerif.data.reprojection import Accuracy, Reprojection
from nerif.fields.field import Field
from nerif.fields.network import Network, NeuralField
from nerif.fields.sum import SumField
from nerif.fields.symmetric import SymmetricVoxels, symmetry_of_field
from nerif.fields.voxel_field import VoxelField
from nerif.fields.walls import WallNetwork
from nerif.forward.forward_model import ForwardModel
from nerif.forward.images import Images
from nerif.forward.model_names import AUTO
from nerif.forward.path_integral import LENS_RAYS, FieldProjector, PathIntegral, project
from nerif.forward.ray_tracing import CurvedRays
from nerif.forward.registry import ASSUMED, TECHNIQUES, check_simulated, forward_model, forward_models
from nerif.geometry import Box, Camera, Grid, Rays
from nerif.reconstruction.device import on_free_cores
from nerif.reconstruction.voxels.operator import rays_through
from nerif.reconstruction.voxels.symmetric_operator import project_spline

VOXEL_STEP = {"linear": 0.1, "cubic": 0.25}  # voxels between samples
SAMPLES = 80  # per ray; error 0.06 % of the rms displacement for a network fitted to the flame
SAMPLES_PER_VOXEL = 2  # the same for the splines of its detail
GRADIENT_COST = 3.0  # of value and gradient, in evaluations: a forward pass and a backward pass of twice its work
EXACT_WORK = {"cpu": 3e10, "gpu": 1e13}  # multiplications: a second on two cores
WALLS = 5  # times as many beside bodies, where splines would smooth the jump across a thin plate
SPLINE_VOXELS, SPLINE_MARGIN = 100, 3  # along the longest edge of the box, at least, and beyond each face
VALIDATION_VOXELS = 80  # of splines through the field of a short run
MOST_VOXELS = 256  # along the longest edge of a volume whose values are those of the splines
SYMMETRIC_VOXELS = 400  # along the longest edge of (r, h)
RAYS_PER_VOXEL = 1.4  # along an edge, at least
COMPARED_PIXELS = 1024
MAX_THIN_RAYS = 1 << 21  # per call of the voxel operator

Splines = (VoxelField, SymmetricVoxels)
__all__ = [
    "TRACED", "VALIDATION_VOXELS", "SampledViews", "check_sees", "evaluations", "on_grid", "on_voxels", "predict",
    "predict_view", "reproject", "spline_voxels", "splines_for_views",
]  # fmt: skip

TRACED = "traced"  #: name of the deflection model that traces rays through the field, to all orders


def check_sees(techniques: Sequence[type[ForwardModel]], quantity: str, what: str) -> None:
    """Raise an error for a technique that does not measure the quantity; `what` names the parameter or file."""
    for kind in techniques:
        if kind.quantity != quantity:
            names = ", ".join(k.name for k in TECHNIQUES.values() if k.quantity == quantity and not k.derived)
            raise InputError(
                f"expected a technique that measures the field of {name_of(quantity)} ({names}), got {kind.name}",
                field=what,
            )


def predict_view(
    field: Field, camera: Camera, projector: FieldProjector, box: Box, device: torch.device | str = "cpu"
) -> Float[Tensor, "row column c"]:
    """Return the view of a field; 0 where a ray misses the box."""
    linear = isinstance(projector, PathIntegral) and projector.model.linear
    if isinstance(field, SumField) and linear:
        return torch.stack([predict_view(part, camera, projector, box, device) for part in field.parts]).sum(dim=0)
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(box).to(dtype=torch.float32)
    if not rays.crosses.any():
        return torch.zeros(*camera.image_size, projector.channels)
    if isinstance(field, Splines) and isinstance(projector, PathIntegral) and linear:
        view = _through_voxels(field, rays, projector.model, device)
    else:
        view = project(projector, field, rays, device)
    return view.reshape(*camera.image_size, projector.channels)


def _through_voxels(
    field: VoxelField | SymmetricVoxels, rays: Rays, model: ForwardModel, device: torch.device | str
) -> Float[Tensor, "n c"]:
    """The result of `project` by the compiled operator, tens of times faster."""
    section = field if isinstance(field, VoxelField) else field.parts[0]
    step = VOXEL_STEP["linear" if section.degree == 1 else "cubic"]
    thin_rays, parts = rays_through(rays, min(field.grid.spacing)), []
    for index in torch.arange(len(rays)).split(max(1, MAX_THIN_RAYS // thin_rays)):
        pause()
        part = rays[index]
        if bool(part.crosses.any()):
            parts.append(project_spline(field, part, model, step, device).cpu())
        else:
            parts.append(torch.zeros(len(part), len(model.channels)))
    return torch.cat(parts)


@on_free_cores
def predict(
    field: Field, cameras: Sequence[Camera], box: Box, n_ambient: float, model: str = AUTO, samples: int = 200,
    on_view: Callable[[int, int], None] = lambda done, total: None, technique: type[ForwardModel] = ASSUMED,
    wavelength_nm: float | None = None, quantity: str | None = None,
) -> Measurement:  # fmt: skip
    """Return the measurement of a field by cameras, without noise.

    Parameters
    ----------
    field : of the quantity that the technique measures; of an index the excess over n_ambient
    box : outside of which the field is ambient, mm
    model : auto, a model of the technique, or traced: rays traced through the field
    samples : per ray, or Runge-Kutta steps of a traced one
    on_view : called with the numbers of predicted views and of all views
    technique : what a pixel measures
    wavelength_nm : of the light, for interferometry
    quantity : of the field (volume.QUANTITIES), to be checked against the technique; None for no check
    """
    check_simulated((technique,))
    if quantity is not None:
        check_sees((technique,), quantity, "technique")
    shape = (len(cameras), *(max(c.image_size[i] for c in cameras) for i in (0, 1)), len(technique.channels))
    cameras, empty = tuple(technique.seen_by(c) for c in cameras), torch.zeros(shape)
    measurement = measurement_of({technique: empty}, cameras, box, n_ambient, wavelength_nm)
    projector: FieldProjector
    if model == TRACED and technique.traced:
        projector = CurvedRays(samples, n_ambient)
    else:
        projector = PathIntegral(forward_models((technique,), measurement, model)[0], samples)
    predicted = torch.full(shape, float("nan"))
    for i, camera in enumerate(cameras):
        h, w = camera.image_size
        predicted[i, :h, :w] = predict_view(field, camera, projector, box)
        on_view(i + 1, len(cameras))
    return measurement.observed({technique.name: predicted})


@on_free_cores
def reproject(
    field: Field, measurement: Measurement, withheld: Collection[str] = (), device: torch.device | str = "cpu",
    on_view: Callable[[int, int], None] = lambda done, total: None, model: str = AUTO,
    splines: VoxelField | SymmetricVoxels | None = None,
) -> Reprojection:  # fmt: skip
    """Predict every view of a measurement from a field, for each of its techniques.

    The path integral through a network is computed on every pixel if that takes some seconds. For larger images the
    network is sampled on voxels (`SampledViews`); the error is then measured on a sample of pixels, see `accuracies`.

    Parameters
    ----------
    withheld : names of the views that the reconstruction did not use
    on_view : called with the numbers of predicted views and of all views
    model : forward model of the reconstruction
    splines : through the network, if there are some already (`splines_for_views`)
    """
    box, maps, accuracies, done = measurement.box, {}, {}, 0
    integrals: dict[tuple[ForwardModel, int], Tensor] = {}  # images and displacements share one
    _, *added = _parts(field)
    splines = splines or splines_for_views(field, measurement, device)
    total = sum(len(_views_of(kind, measurement.cameras)) for kind in measurement.techniques)
    for observation in measurement.observations:
        kind = observation.technique
        forward = forward_model(kind, measurement, model)
        images = forward if isinstance(forward, Images) else None
        integral = forward if images is None else images.integral
        projector = PathIntegral(integral, _samples(field))
        sampled = None if splines is None else SampledViews(field, (splines, *added), box, projector, device)
        predicted = torch.full_like(observation.values, float("nan"))
        views = [(i, kind.seen_by(measurement.cameras[i])) for i in _views_of(kind, measurement.cameras)]
        for i, camera in views:
            height, width = camera.image_size
            if (integral, i) not in integrals and sampled:
                crosses = measurement.sees_box[i, :height, :width, None]
                integrals[integral, i] = sampled(camera).where(crosses, torch.zeros(()))
            elif (integral, i) not in integrals:
                integrals[integral, i] = predict_view(field, camera, projector, box, device)
            of_view = integrals[integral, i]
            predicted[i, :height, :width] = of_view if images is None else images.to_map(of_view, i)
            done += 1
            on_view(done, total)
        if measurement.hidden is not None:
            predicted[measurement.hidden] = torch.nan  # they see a body
        maps[kind.name] = predicted
        technique = kind if images is None else type(integral)
        if technique.measured not in accuracies:
            accuracies[technique.measured] = Accuracy(technique)
            if sampled:
                accuracies[technique.measured] = sampled.accuracy(
                    technique, [camera for _, camera in views], [integrals[integral, i] for i, _ in views]
                )
    return Reprojection(measurement, maps, tuple(withheld), tuple(accuracies.values()))


def _views_of(kind: type[ForwardModel], cameras: Sequence[Camera]) -> list[int]:
    """The views that a technique can have: those with a background, if it needs one."""
    return [i for i, camera in enumerate(cameras) if camera.background or not kind.background]


def _is_exact(network: Network, points: float, device: torch.device | str) -> bool:
    """Whether the path integral through a network is computed on every pixel, at some points in all."""
    most = EXACT_WORK["cpu" if torch.device(device).type == "cpu" else "gpu"]
    walls = WALLS if isinstance(network, WallNetwork) else 1
    return sum(p.numel() for p in network.parameters()) * points <= most * walls


def _samples(field: Field) -> int:
    """Samples along a ray."""
    if not isinstance(field, SumField):
        return SAMPLES
    return max([SAMPLES, *(SAMPLES_PER_VOXEL * max(p.grid.shape) for p in field.parts if isinstance(p, Splines))])


def _points(cameras: Sequence[Camera]) -> float:
    """Samples along the rays of all pixels."""
    samples = [SAMPLES * (1 if c.lens is None else LENS_RAYS / 2) for c in cameras]
    return sum(n * c.image_size[0] * c.image_size[1] for n, c in zip(samples, cameras, strict=True))


def evaluations(
    network: Network, cameras: Sequence[Camera], box: Box, voxels: int, device: torch.device | str = "cpu"
) -> float:
    """Return how many evaluations of a network its volume (`voxels` along the longest edge) and its views take.

    Value and gradient count as GRADIENT_COST of them.
    """
    volume, points = math.prod(Grid.of_resolution(box, voxels).shape), _points(cameras)
    if _is_exact(network, points, device):
        return volume + GRADIENT_COST * points
    splines = math.prod(_extended(Grid.of_resolution(box, spline_voxels(voxels)), (0, 1, 2)).shape)
    return float(splines if voxels == spline_voxels(voxels) else volume + splines)


def spline_voxels(voxels: int) -> int:
    """Voxels of the splines beside a volume of `voxels` along the longest edge: the same if they are enough."""
    return voxels if SPLINE_VOXELS <= voxels <= MOST_VOXELS else SPLINE_VOXELS


def _parts(field: Field) -> tuple[Field, ...]:
    return field.parts if isinstance(field, SumField) else (field,)


def splines_for_views(
    field: Field, measurement: Measurement, device: torch.device | str = "cpu", voxels: int = SPLINE_VOXELS
) -> VoxelField | SymmetricVoxels | None:
    """Return splines through the network of a field for its views; None without a network, or for few pixels."""
    network = _parts(field)[0]
    if not isinstance(network, NeuralField) or _is_exact(network.network, _points(measurement.cameras), device):
        return None
    return on_voxels(network, measurement.box, device, voxels)


def on_grid(field: Field, splines: VoxelField | SymmetricVoxels | None, grid: Grid) -> Field:
    """Return a field with the same values on a grid: with splines instead of its network, if these go through them."""
    if not isinstance(splines, VoxelField) or splines.grid != _extended(grid, (0, 1, 2)):
        return field
    _, *added = _parts(field)
    return SumField(splines, *added) if added else splines


def on_voxels(
    field: Field, box: Box, device: torch.device | str = "cpu", voxels: int = SPLINE_VOXELS
) -> VoxelField | SymmetricVoxels:
    """Return cubic splines through a field on voxels that extend beyond the box, to be accurate at its faces."""
    symmetry = symmetry_of_field(field)
    if symmetry is not None:
        reduced, size = symmetry.reduced_box(box, ()), max(box.edges) / SYMMETRIC_VOXELS
        left = -reduced.upper[0] if symmetry.axial else reduced.lower[0]
        whole = Box((left, *reduced.lower[1:]), reduced.upper)
        shape = (math.ceil(whole.edges[2] / size), 2, math.ceil(whole.edges[0] / size))
        return SymmetricVoxels.through(field, symmetry, _extended(Grid(whole, shape), (0, 2)), device)
    grid = _extended(Grid.of_resolution(box, voxels), (0, 1, 2))
    return VoxelField.through(field.sample(grid, device), grid)


def _extended(grid: Grid, axes: Sequence[int]) -> Grid:
    """The grid with SPLINE_MARGIN more voxels beyond its faces across some of x, y, z."""
    lower, upper, shape = list(grid.box.lower), list(grid.box.upper), list(grid.shape)
    for axis in axes:
        lower[axis] -= SPLINE_MARGIN * grid.spacing[axis]
        upper[axis] += SPLINE_MARGIN * grid.spacing[axis]
        shape[2 - axis] += 2 * SPLINE_MARGIN
    return Grid(Box((lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2])), (shape[0], shape[1], shape[2]))


@dataclass(frozen=True)
class SampledViews:
    """Views of a network from its values on voxels, plus those of splines that are added to it.

    A lattice of rays, RAYS_PER_VOXEL, is integrated through the spline by the compiled operator, with bicubic
    interpolation between its pixels. The effect of bending (`curved`) is integrated through the network on a coarser
    lattice.
    """

    field: Field  #: the network, or its sum with splines
    splines: tuple[Field, ...]  #: through the values of the network (`on_voxels`), and those that are added to it
    box: Box  #: where the rays are integrated, mm
    projector: PathIntegral  #: the path integral through the field
    device: torch.device | str = "cpu"  #: of the network

    def __call__(self, camera: Camera) -> Float[Tensor, "row column c"]:
        """Return the view of a camera; undefined where a ray misses the box."""
        pixel = float(camera.pixel_size(torch.tensor(self.box.centre, dtype=camera.rotation.dtype)))
        step = max(1, int(max(self.box.edges) / self.resolution / (RAYS_PER_VOXEL * pixel)))
        straight = self.projector.model.linear_twin
        voxels, *added = self.splines
        assert isinstance(voxels, Splines)
        view = _interpolated(camera, self.box, step, lambda rays: project_spline(voxels, rays, straight))
        for part in added:
            view = view + predict_view(part, camera, replace(self.projector, model=straight), self.box, self.device)
        if not self.projector.model.straight:
            view = view + _interpolated(camera, self.box, 8 * step, self._bending)
        return view

    @property
    def resolution(self) -> int:
        """Voxels along the longest edge of the box."""
        splines = self.splines[0]
        if not isinstance(splines, VoxelField):
            return SYMMETRIC_VOXELS
        return max(splines.grid.shape) - 2 * SPLINE_MARGIN

    def _bending(self, rays: Rays) -> Float[Tensor, "n c"]:
        """The difference between bent and straight rays."""
        projectors = self.projector, replace(self.projector, model=self.projector.model.linear_twin)
        bent, straight = (project(projector, self.field, rays, self.device) for projector in projectors)
        return bent - straight

    def accuracy(self, kind: type[ForwardModel], cameras: Sequence[Camera], predicted: Sequence[Tensor]) -> Accuracy:
        """Compare predicted views, (row, column, c) each, with the path integral through the field on random pixels."""
        generator = torch.Generator().manual_seed(0)
        errors = []
        for camera, view in zip(cameras, predicted, strict=True):
            size = torch.tensor(camera.image_size[::-1])
            pixels = (torch.rand(-(-COMPARED_PIXELS // len(cameras)), 2, generator=generator) * size).long()
            rays = camera.rays(pixels.to(camera.intrinsics)).clip(self.box).to(dtype=torch.float32)
            exact = project(self.projector, self.field, rays, self.device)
            errors.append((view[pixels[:, 1], pixels[:, 0]] - exact)[rays.crosses])
        error = torch.cat(errors)
        spline = f"a cubic spline through the network on {self.resolution} voxels along the longest edge of the box"
        return Accuracy(kind, spline, float(error.square().mean().sqrt()), len(error))


def _interpolated(
    camera: Camera, box: Box, step: int, integrate: Callable[[Rays], Float[Tensor, "n c"]]
) -> Float[Tensor, "row column c"]:
    """The integrals on every step-th row and column, with bicubic splines between them."""
    from scipy.interpolate import RectBivariateSpline

    step = max(1, min(step, min(camera.image_size) // 4))  # a cubic spline has at least four knots
    rows, columns = (torch.arange(0, n + step - 1, step).clamp(max=n - 1) for n in camera.image_size)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    pixels = torch.stack([u, v], dim=-1).reshape(-1, 2).to(camera.intrinsics)
    rays = camera.rays(pixels).clip(box).to(dtype=torch.float32)
    if not rays.crosses.any():
        return torch.zeros(())
    lattice = integrate(rays).unflatten(0, (len(rows), len(columns)))
    if step == 1:
        return lattice
    at = [torch.arange(n).numpy() for n in camera.image_size]
    maps = [RectBivariateSpline(rows.numpy(), columns.numpy(), channel.numpy())(*at) for channel in lattice.unbind(-1)]
    return torch.stack([torch.from_numpy(m).float() for m in maps], dim=-1)
