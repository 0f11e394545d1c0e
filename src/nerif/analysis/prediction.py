"""What cameras would see of a field that is known."""

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
from nerif.data.reprojection import Accuracy, Reprojection
from nerif.data.volume import name_of
from nerif.fields.base import Field
from nerif.fields.grid import VoxelField
from nerif.fields.network import NeuralField
from nerif.fields.symmetric import SymmetricVoxels, symmetry_of_field
from nerif.forward.base import ForwardModel
from nerif.forward.path_integral import LENS_RAYS, PathIntegral, Projector, project
from nerif.forward.ray_tracing import CurvedRays
from nerif.forward.registry import ASSUMED, AUTO, TECHNIQUES, check_simulated, forward_model, forward_models
from nerif.geometry import Box, Camera, Grid, Rays
from nerif.reconstruction.device import on_free_cores
from nerif.reconstruction.voxels.operator import rays_through
from nerif.reconstruction.voxels.symmetric_operator import project_spline

VOXEL_STEP = {"linear": 0.1, "cubic": 0.25}  # voxels between samples
SAMPLES = 80  # a ray; 0.06 % of the rms displacement of a network fitted to the flame
EXACT_WORK = {"cpu": 2.5e11, "cuda": 2.5e13}  # multiplications: ten seconds on two cores
VOXELS, BEYOND = 100, 3  # along the longest edge of the box, and beyond each face
SYMMETRIC_VOXELS = 400  # the same, of (r, h) alone
RAYS = 1.4  # along the edge of a voxel, at least
COMPARED = 1024  # pixels
AT_ONCE = 1 << 21  # thin rays through voxels

Splines = (VoxelField, SymmetricVoxels)
__all__ = ["TRACED", "SampledViews", "check_sees", "predict", "predict_view", "reproject"]

TRACED = "traced"
"""Name of the model of deflection that bends rays to every order."""


def check_sees(techniques: Sequence[type[ForwardModel]], quantity: str, what: str) -> None:
    """Refuse techniques that see another field than one of that quantity; `what` names the parameter or file.

    Raises
    ------
    InputError
        Naming those that see it.
    """
    for kind in techniques:
        if kind.quantity != quantity:
            names = ", ".join(k.name for k in TECHNIQUES.values() if k.quantity == quantity and not k.derived)
            field = f"the field of {name_of(quantity)}"
            raise InputError(f"expected a technique that sees {field} ({names}), got {kind.name}", field=what)


def predict_view(
    field: Field, camera: Camera, projector: Projector, box: Box, device: torch.device | str = "cpu"
) -> Float[Tensor, "row column c"]:
    """Return what a camera would see of a field; 0 where a ray misses the box."""
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(box).to(dtype=torch.float32)
    if not rays.crosses.any():
        return torch.zeros(*camera.image_size, projector.channels)
    if isinstance(field, Splines) and isinstance(projector, PathIntegral) and projector.model.linear:
        seen = _through_voxels(field, rays, projector.model, device)
    else:
        seen = project(projector, field, rays, device)
    return seen.reshape(*camera.image_size, projector.channels)


def _through_voxels(
    field: VoxelField | SymmetricVoxels, rays: Rays, model: ForwardModel, device: torch.device | str
) -> Float[Tensor, "n c"]:
    """What `project` gives, by the compiled operator: tens of times faster."""
    flat = field if isinstance(field, VoxelField) else field.parts[0]
    step = VOXEL_STEP["linear" if flat.degree == 1 else "cubic"]
    each, seen = rays_through(rays, min(field.grid.spacing)), []
    for index in torch.arange(len(rays)).split(max(1, AT_ONCE // each)):
        pause()
        part = rays[index]
        if bool(part.crosses.any()):
            seen.append(project_spline(field, part, model, step, device).cpu())
        else:
            seen.append(torch.zeros(len(part), len(model.channels)))
    return torch.cat(seen)


@on_free_cores
def predict(
    field: Field,
    cameras: Sequence[Camera],
    box: Box,
    n_ambient: float,
    model: str = AUTO,
    samples: int = 200,
    on_view: Callable[[int, int], None] = lambda done, total: None,
    technique: type[ForwardModel] = ASSUMED,
    wavelength_nm: float | None = None,
    quantity: str | None = None,
) -> Measurement:
    """Return the measurement that cameras would make of a field, without noise.

    Parameters
    ----------
    field : of what the technique sees; of an index the excess over n_ambient
    box : outside of which the field is ambient, mm
    model : auto or a model of the technique, as a reconstruction has it, or traced: rays bent to every order
    samples : along a ray, or Runge-Kutta steps of a traced one
    on_view : told how many views are done, out of how many
    technique : what a pixel measures
    wavelength_nm : of the light, for interferometry
    quantity : what the field is (volume.QUANTITIES), if that is to be checked

    Raises
    ------
    InputError
        If there is no such model, the technique sees another quantity, or needs what is not given.
    """
    check_simulated((technique,))
    if quantity is not None:
        check_sees((technique,), quantity, "technique")
    shape = (len(cameras), *(max(c.image_size[i] for c in cameras) for i in (0, 1)), len(technique.channels))
    cameras, empty = tuple(technique.seen_by(c) for c in cameras), torch.zeros(shape)
    measurement = measurement_of({technique: empty}, cameras, box, n_ambient, wavelength_nm)
    projector: Projector
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
    field: Field,
    measurement: Measurement,
    withheld: Collection[str] = (),
    device: torch.device | str = "cpu",
    on_view: Callable[[int, int], None] = lambda done, total: None,
    model: str = AUTO,
) -> Reprojection:
    """Predict what every view of a measurement sees of a field, by every technique of the measurement.

    A network is integrated along every ray where that takes some seconds only. Of larger images it is sampled on
    voxels, and the views are interpolated between rays through those (`SampledViews`); how far that is from the
    integral through the network is measured on some pixels, and told as `accuracies`.

    Parameters
    ----------
    withheld : names of the views that the reconstruction has not seen
    on_view : told how many views are done, out of how many
    model : forward model that the field was reconstructed with
    """
    box, maps, accuracies, done = measurement.box, {}, {}, 0
    known: dict[tuple[ForwardModel, int], Tensor] = {}  # images and displacements are of one integral
    many = _work(field, measurement.cameras) > EXACT_WORK[torch.device(device).type]
    voxels = on_voxels(field, box, device) if many else None
    total = sum(len(_seeing(kind, measurement.cameras)) for kind in measurement.techniques)
    for observation in measurement.observations:
        kind = observation.technique
        forward = forward_model(kind, measurement, model)
        projector = PathIntegral(forward.integral, SAMPLES)
        sampled = None if voxels is None else SampledViews(field, voxels, box, projector, device)
        predicted = torch.full_like(observation.values, float("nan"))
        integral = forward.integral
        views = [(i, kind.seen_by(measurement.cameras[i])) for i in _seeing(kind, measurement.cameras)]
        for i, camera in views:
            height, width = camera.image_size
            if (integral, i) not in known and sampled:
                seen = measurement.sees_box[i, :height, :width, None]
                known[integral, i] = sampled(camera).where(seen, torch.zeros(()))
            elif (integral, i) not in known:
                known[integral, i] = predict_view(field, camera, projector, box, device)
            predicted[i, :height, :width] = forward.to_map(known[integral, i], i)
            done += 1
            on_view(done, total)
        maps[kind.name] = predicted
        seen_as = type(integral) if forward.integral is not forward else kind
        if seen_as.measured not in accuracies:
            found = Accuracy(seen_as)
            if sampled:
                integrals = [known[integral, i] for i, _ in views]
                found = sampled.accuracy(seen_as, [camera for _, camera in views], integrals)
            accuracies[seen_as.measured] = found
    return Reprojection(measurement, maps, tuple(withheld), tuple(accuracies.values()))


def _seeing(kind: type[ForwardModel], cameras: Sequence[Camera]) -> list[int]:
    """Which cameras can see by a technique: those with a background, where it needs one."""
    return [i for i, camera in enumerate(cameras) if camera.background or not kind.background]


def _work(field: Field, cameras: Sequence[Camera]) -> float:
    """Multiplications of the path integral through a network on every pixel; 0 for other fields."""
    if not isinstance(field, NeuralField):
        return 0.0
    weights = sum(p.numel() for p in field.network.parameters())
    samples = [SAMPLES * (1 if c.lens is None else LENS_RAYS / 2) for c in cameras]
    pixels = [c.image_size[0] * c.image_size[1] for c in cameras]
    return float(weights) * sum(n * m for n, m in zip(samples, pixels, strict=True))


def on_voxels(field: Field, box: Box, device: torch.device | str = "cpu") -> VoxelField | SymmetricVoxels:
    """Return the cubic splines through a field's values on voxels that go on beyond the box: right up to its faces."""
    symmetry = symmetry_of_field(field)
    if symmetry is not None:
        reduced, size = symmetry.reduced_box(box, ()), max(box.edges) / SYMMETRIC_VOXELS
        left = -reduced.upper[0] if symmetry.axial else reduced.lower[0]
        whole = Box((left, *reduced.lower[1:]), reduced.upper)
        shape = (math.ceil(whole.edges[2] / size), 2, math.ceil(whole.edges[0] / size))
        return SymmetricVoxels.through(field, symmetry, _beyond(Grid(whole, shape), (0, 2)), device)
    grid = _beyond(Grid.of_resolution(box, VOXELS), (0, 1, 2))
    return VoxelField.through(field.sample(grid, device), grid)


def _beyond(grid: Grid, axes: Sequence[int]) -> Grid:
    """The grid with BEYOND voxels more beyond its faces across some of x, y, z."""
    lower, upper, shape = list(grid.box.lower), list(grid.box.upper), list(grid.shape)
    for axis in axes:
        lower[axis] -= BEYOND * grid.spacing[axis]
        upper[axis] += BEYOND * grid.spacing[axis]
        shape[2 - axis] += 2 * BEYOND
    return Grid(Box((lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2])), (shape[0], shape[1], shape[2]))


@dataclass(frozen=True)
class SampledViews:
    """Views of a network by way of its values on voxels.

    Rays of a lattice of pixels, RAYS a voxel, are integrated through the spline by the compiled
    operator, and the pixels between them are interpolated by bicubic splines. What bending adds (`curved`) is
    integrated through the network itself on a coarser lattice.

    Parameters
    ----------
    field : the network
    voxels : spline through its values (`on_voxels`)
    box : where the rays are integrated, mm
    projector : the path integral through the network
    device : where the network is evaluated
    """

    field: Field
    voxels: VoxelField | SymmetricVoxels
    box: Box
    projector: PathIntegral
    device: torch.device | str = "cpu"

    def __call__(self, camera: Camera) -> Float[Tensor, "row column c"]:
        """Return what a camera would see; of no meaning where a ray misses the box."""
        pixel = float(camera.pixel_size(torch.tensor(self.box.centre, dtype=camera.rotation.dtype)))
        step = max(1, int(max(self.box.edges) / self.resolution / (RAYS * pixel)))
        view = _interpolated(camera, self.box, step, self._straight)
        if not self.projector.model.straight:
            view = view + _interpolated(camera, self.box, 8 * step, self._bending)
        return view

    @property
    def resolution(self) -> int:
        """Voxels along the longest edge of the box."""
        return VOXELS if isinstance(self.voxels, VoxelField) else SYMMETRIC_VOXELS

    @property
    def _straight_model(self) -> ForwardModel:
        return self.projector.model.linear_twin

    def _straight(self, rays: Rays) -> Float[Tensor, "n c"]:
        return project_spline(self.voxels, rays, self._straight_model)

    def _bending(self, rays: Rays) -> Float[Tensor, "n c"]:
        """What bent rays see more than straight ones."""
        projectors = self.projector, replace(self.projector, model=self._straight_model)
        bent, straight = (project(projector, self.field, rays, self.device) for projector in projectors)
        return bent - straight

    def accuracy(self, kind: type[ForwardModel], cameras: Sequence[Camera], predicted: Sequence[Tensor]) -> Accuracy:
        """Compare predicted views, (row, column, c) each, with the path integral through the field, on some pixels."""
        generator = torch.Generator().manual_seed(0)
        apart = []
        for camera, view in zip(cameras, predicted, strict=True):
            size = torch.tensor(camera.image_size[::-1])
            pixels = (torch.rand(-(-COMPARED // len(cameras)), 2, generator=generator) * size).long()
            rays = camera.rays(pixels.to(camera.intrinsics)).clip(self.box).to(dtype=torch.float32)
            exact = project(self.projector, self.field, rays, self.device)
            apart.append((view[pixels[:, 1], pixels[:, 0]] - exact)[rays.crosses])
        difference = torch.cat(apart)
        voxels = f"{self.resolution} voxels along the longest edge of the box"
        how = f"a cubic spline through the network's values on {voxels}"
        return Accuracy(kind, how, float(difference.square().mean().sqrt()), len(difference))


def _interpolated(
    camera: Camera, box: Box, step: int, see: Callable[[Rays], Float[Tensor, "n c"]]
) -> Float[Tensor, "row column c"]:
    """What `see` makes of rays, on every step-th row and column, and by bicubic splines between them."""
    from scipy.interpolate import RectBivariateSpline

    step = max(1, min(step, min(camera.image_size) // 4))  # a cubic spline has four knots at least
    rows, columns = (torch.arange(0, n + step - 1, step).clamp(max=n - 1) for n in camera.image_size)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    pixels = torch.stack([u, v], dim=-1).reshape(-1, 2).to(camera.intrinsics)
    rays = camera.rays(pixels).clip(box).to(dtype=torch.float32)
    if not rays.crosses.any():
        return torch.zeros(())
    seen = see(rays).unflatten(0, (len(rows), len(columns)))
    if step == 1:
        return seen
    at = [torch.arange(n).numpy() for n in camera.image_size]
    maps = [RectBivariateSpline(rows.numpy(), columns.numpy(), channel.numpy())(*at) for channel in seen.unbind(-1)]
    return torch.stack([torch.from_numpy(m).float() for m in maps], dim=-1)
