"""Refinement of a rig with the field: poses and focal lengths of cameras, distance of backgrounds, shifts of images.

    d = A(theta_v) f + c_v + C_v x        theta_v: corrections of camera v (geometry/pose.py), x in the image
    min  sum |d - measured|^2 / sigma^2 + sum theta^2 / sigma_theta^2

A step is one Gauss-Newton step of each camera against the present field; between two steps the field adapts. It adapts
to wrong cameras so well that a step sees only part of the error; hence steps of cameras have momentum. A shift of an
image is seen whole. The field can adapt entirely to a rigid motion of all cameras and to a common stretch of all
images; these are removed: the mean correction, weighted by the priors, stays 0.

The residual of an unfinished field is not noise and is correlated between pixels. So data have little weight at first,
and where they say less than the prior, the prior decides (docs/refinement.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Box, Camera, Rays
from nerif.geometry.pose import GEOMETRY, Corrections
from nerif.reconstruction.gauss_newton import Information
from nerif.reconstruction.reconstructor import Reconstruction
from nerif.reconstruction.rig_groups import GROUPS, refined_groups
from nerif.reconstruction.rig_parameters import (
    NAMES,
    RefinedView,
    displaced,
    prior,
    with_corrections,
)
from nerif.reconstruction.sources import of_source
from nerif.reconstruction.target import Target, TechniqueData

__all__ = ["MOMENTUM", "Refinement", "load_rig", "random_pixels", "refit", "rig_state", "with_rig"]

MOMENTUM = 0.6
STEP_PX = 0.3  # movement of rays at the middle of the box for finite differences
CORRELATED = 20.0  # neighbouring pixels with the same unexplained residual
PIXELS = 150  # per view and step
SIGN, SIGNS = 0.012, 2  # share of the residual per parameter, and times in a row, that show a pose error
STRETCHES = ("u_x", "v_y")  # of all images: a field that is a parabola across, or along the axis, explains them
MIN_WEIGHT = 0.05  # in the common mean, of a direction without information from the data
REFIT_STEPS, REFIT_PIXELS, REFIT_SAMPLES = 6, 600, 64  # steps, pixels per view and step, samples per ray

Predict = Callable[[TechniqueData, Rays], Float[Tensor, "n k"]]
"""Returns the path integral of the present field along rays of a part."""


class Refinement:
    """The refined parameters of a rig.

    Parameters
    ----------
    cameras : as calibrated
    box : of the field, mm
    sigma : (view, 14) prior standard deviation of each of NAMES; 0 if it is not refined
    gauged : whether the field adapts, so that common motions and stretches are removed
    """

    def __init__(
        self, cameras: Sequence[Camera], box: Box, sigma: Float[Tensor, "view 14"], gauged: bool = True
    ) -> None:
        self.cameras, self.box, self.sigma, self.gauged = tuple(cameras), box, sigma.double(), gauged
        self.names = tuple(camera.name for camera in self.cameras)
        self.velocity = torch.zeros_like(self.sigma)
        self.steps = 0  # in this cycle of a run
        self.signs = 0  # times in a row that the data have shown a pose error
        self.explained = torch.zeros(len(self.cameras), dtype=torch.float64)
        """Share of the residual of each view that its parameters explain, beyond what they explain of noise."""
        self.columns = [i for i in range(len(NAMES)) if bool((self.sigma[:, i] > 0).any())]
        self._half = torch.tensor([max(c.image_size) / 2 for c in self.cameras])
        self._middle = torch.tensor([[(n - 1) / 2 for n in c.image_size[::-1]] for c in self.cameras])
        self.values = torch.zeros_like(self.sigma)

    @classmethod
    def for_measurement(
        cls, measurement: Measurement, refine: Sequence[str], mm: float | None = None, deg: float | None = None,
        px: float = 0.05, gauged: bool = True,
    ) -> Refinement:  # fmt: skip
        """Return the refinement of some of GROUPS, with standard deviations as for `prior`."""
        groups = refined_groups(refine)
        sigma = torch.stack([prior(camera, mm, deg, px) for camera in measurement.cameras])
        if "cameras" in groups and not bool(sigma[:, :6].any()):
            raise InputError("expected standard deviations above 0 to refine cameras, got none", field="pose_sigma")
        if "shift" in groups and any(not kind.windowed for kind in measurement.techniques):
            names = " and ".join(o.technique.measured for o in measurement.observations)
            raise InputError(
                f"expected displacements only for 'shift', got {names}; for images give --from displacements",
                field="refine",
            )
        if "background" in groups and any(camera.background is None for camera in measurement.cameras):
            raise InputError("expected cameras with a background for 'background', got some without", field="refine")
        refined = torch.zeros(len(NAMES), dtype=torch.bool)
        for group in groups:
            refined[list(GROUPS[group])] = True
        return cls(measurement.cameras, measurement.box, torch.where(refined, sigma, 0.0), gauged)

    @classmethod
    def of_table(
        cls, measurement: Measurement, settings: Mapping[str, Any], table: Sequence[RefinedView], gauged: bool = True
    ) -> Refinement:
        """Return the refinement of settings with the values of a table, of these and possibly other views."""
        sigma = (settings["pose_sigma_mm"], settings["pose_sigma_deg"], settings["shift_sigma_px"])
        rig = cls.for_measurement(measurement, settings["refine"], *sigma, gauged=gauged)
        rows, values = {row["name"]: row["values"] for row in table}, rig.values.clone()
        for v, view in enumerate(rig.names):
            for name, value in rows.get(view, {}).items():
                values[v, NAMES.index(name)] = value
        rig.values = values
        return rig

    # -- the refined rig -----------------------------------------------------------------------------------------

    @property
    def values(self) -> Float[Tensor, "view 14"]:
        """The parameters; replace the tensor to change them."""
        return self._values

    @values.setter
    def values(self, values: Float[Tensor, "view 14"]) -> None:
        self._values, self._corrections = values, self._of(values)

    def _of(self, values: Float[Tensor, "view 14"]) -> Corrections:
        return Corrections(self.cameras, values[:, : len(GEOMETRY)])

    @property
    def corrected(self) -> tuple[Camera, ...]:
        """The refined cameras."""
        return self._corrections.corrected

    @property
    def off(self) -> bool:
        """Whether the data have shown a pose error."""
        return self.signs >= SIGNS

    def of(self, part: TechniqueData, cameras: Sequence[int] | None = None) -> TechniqueData:
        """Return a part, of all views or those of some cameras, with refined rays and displacements of its images."""
        rays = part.rays
        if cameras is not None and list(cameras) != list(range(len(self.cameras))):
            rays = replace(rays, view=torch.tensor(cameras, device=rays.view.device).to(rays.view)[rays.view.long()])
        geometric = any(i < len(GEOMETRY) for i in self.columns)
        corrected = self._corrections.apply(rays, self.box) if geometric else rays
        return replace(part, rays=replace(corrected, view=part.rays.view), offset=self._offset(self.values, rays))

    def table(self) -> list[RefinedView]:
        """Return the estimates of every view."""
        rows = list[RefinedView]()
        for v, (camera, corrected) in enumerate(zip(self.cameras, self.corrected, strict=True)):
            value, sigma = self.values[v], self.sigma[v]
            shift = self._middle_in(corrected) - self._middle_in(camera) + value[len(GEOMETRY) :][:2]
            slopes = self.aside(v) * sigma[self.columns]
            size = float((shift @ torch.linalg.pinv(slopes @ slopes.T, hermitian=True) @ shift).clamp(min=0).sqrt())
            most = max((abs(float(value[i] / sigma[i])) for i in self.columns if sigma[i] > 0), default=0.0)
            values, prior_sigma = ({NAMES[i]: float(x[i]) for i in self.columns} for x in (value, sigma))
            rows.append({
                "name": camera.name, "correction_over_sigma": max(most, size), "image_shift_px": float(shift.norm()),
                "values": values, "prior_sigma": prior_sigma,
            })  # fmt: skip
        return rows

    def aside(self, view: int) -> Float[Tensor, "2 k"]:
        """Return the derivative of the middle of the box in the image of a view by its refined parameters, px."""
        increments, slopes = self._increments()[view], []
        here = self._middle_in(self.cameras[view])
        for i in self.columns:
            change = torch.zeros(len(NAMES), dtype=torch.float64)
            change[i] = increments[i]
            corrected = Corrections(self.cameras[view : view + 1], change[None, : len(GEOMETRY)]).corrected[0]
            slopes.append((self._middle_in(corrected) - here + change[len(GEOMETRY) :][:2]) / increments[i])
        return torch.stack(slopes, dim=1)

    def _middle_in(self, camera: Camera) -> Float[Tensor, 2]:
        """Image of the middle of the box, px."""
        return camera.project(torch.tensor([self.box.centre], dtype=camera.rotation.dtype))[0].double()

    # -- steps ---------------------------------------------------------------------------------------------------

    def step(
        self, parts: Sequence[TechniqueData], predict: Predict, sigma_known: bool = True, momentum: float = MOMENTUM,
        sign_factor: float = 0.0,
    ) -> None:  # fmt: skip
        """Take a Gauss-Newton step plus a share of the step before.

        Parameters
        ----------
        parts : pixels with their calibrated rays, residuals in units of sigma
        predict : of the present field
        sigma_known : whether residuals are in sigma; else their unit is arbitrary
        sign_factor : if above 0, nothing moves before the data have shown a pose error by that factor times SIGN per
            parameter, since the residual of an unfinished field moves the rig as well
        """
        self.steps += 1
        if not parts:
            return
        normal, right = self.normal_equations(parts, predict, sigma_known)
        if sign_factor and not self.off:
            sign = float(self.explained.median()) > sign_factor * SIGN * len(self.columns)
            self.signs = self.signs + 1 if sign else 0
            if not self.off:
                return
        sigma = self.sigma[:, self.columns]  # 0 for a parameter that a view does not refine: it stays
        information = Information(sigma[:, :, None] * normal * sigma[:, None])
        data_weight = 1 + information.values  # directions with much information are free of the prior
        at, change = self.values[:, self.columns] / sigma.clamp(min=1e-30), torch.zeros_like(self.values)
        change[:, self.columns] = sigma * information.step(sigma * right, at, data_weight)
        gathered = momentum * self.velocity
        gathered[:, len(GEOMETRY) :] = 0
        self.velocity = gathered + change
        share = (information.values / data_weight).clamp(min=MIN_WEIGHT)
        weights = share.sqrt()[:, :, None] * information.directions.mT
        self.values = self._centred(self.values + self.velocity, weights)

    def normal_equations(
        self, parts: Sequence[TechniqueData], predict: Predict, sigma_known: bool = True
    ) -> tuple[Float[Tensor, "view k k"], Float[Tensor, "view k"]]:
        """Return J^T W J and -J^T W r of each view for its refined parameters."""
        views, k = len(self.cameras), len(self.columns)
        normal = torch.zeros(views, k, k, dtype=torch.float64)
        right = torch.zeros(views, k, dtype=torch.float64)
        fits = torch.zeros(views, 4, dtype=torch.float64)  # squares explained, all squares, parameters, residuals
        for part in parts:
            now, jacobian = self.slopes(part, predict)
            view = part.rays.view.long().cpu()
            weight = (part.outlier / now.abs().clamp(min=1e-30)).clamp(max=1.0)
            for v in range(views):
                pixels = view == v
                if not bool(pixels.any()):
                    continue
                j, r, w = jacobian[pixels].flatten(0, 1), now[pixels].flatten(), weight[pixels].flatten()
                level = float((w * r.square()).mean())
                level, excess = (max(level, 1.0), max(level - 1, 0.0)) if sigma_known else (max(level, 1e-30), 1.0)
                each = 1 / (level * (1 + CORRELATED * min(excess, 1.0)))
                fit = torch.linalg.lstsq(w.sqrt()[:, None] * j, w.sqrt() * r).solution
                squares = (w.sqrt() * (j @ fit)).square().sum(), (w * r.square()).sum()
                fits[v] += torch.stack([*squares, *torch.tensor([k, len(r)], dtype=torch.float64)])
                normal[v] += each * (j.T * w) @ j
                right[v] -= each * (j.T * w) @ r
        explained, total, parameters, count = fits.clamp(min=1e-30).unbind(dim=1)
        self.explained = explained / total - parameters / count
        return normal, right

    def slopes(self, part: TechniqueData, predict: Predict) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n c k"]]:
        """Return the residual of a part, and its derivatives by the refined parameters."""
        increments = self._increments()
        now, integral = self.residual(part, self.values, predict)
        slopes = []
        for i in self.columns:
            other = self.values.clone()
            other[:, i] += increments[:, i]
            there, _ = self.residual(part, other, predict, integral if i >= len(GEOMETRY) else None)
            slopes.append((there - now) / increments[:, i].to(now)[part.rays.view.long()][:, None])
        return now.cpu().double(), torch.stack(slopes, dim=-1).cpu().double()

    def residual(
        self, part: TechniqueData, values: Float[Tensor, "view 14"], predict: Predict, integral: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the residual of a part of calibrated rays, without reducing outliers, and the path integral."""
        if integral is None:
            integral = predict(part, self._of(values).apply(part.rays, self.box))
        offset = self._offset(values, part.rays)
        prediction = integral if offset is None else integral + offset
        return part.difference(prediction) * part.inverse_scale, integral

    def state_dict(self) -> dict[str, Tensor]:
        """Return what a checkpoint stores."""
        counts = {"done": torch.tensor(self.steps), "signs": torch.tensor(self.signs)}
        return {"values": self.values.clone(), "velocity": self.velocity.clone(), **counts}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Continue from the state of a checkpoint."""
        self.values, self.velocity = state["values"].clone(), state["velocity"].clone()
        self.steps, self.signs = int(state["done"]), int(state["signs"])

    def _centred(
        self, values: Float[Tensor, "view 14"], weights: Float[Tensor, "view k k"] | None = None
    ) -> Float[Tensor, "view 14"]:
        """The parameters minus the mean of `_modes`, with square roots of weights for parameters in units of sigma."""
        modes = self._modes()
        if not self.gauged or not modes.shape[-1]:
            return values
        sigma = self.sigma[:, self.columns].clamp(min=1e-30)
        scaled = modes[:, self.columns] / sigma[..., None]
        if weights is None:
            weights = torch.eye(len(self.columns), dtype=torch.float64).expand(len(self.cameras), -1, -1)
        weighted = weights @ (values[:, self.columns] / sigma)[..., None]
        mean = torch.linalg.lstsq((weights @ scaled).flatten(0, 1), weighted.flatten(0, 1)).solution[:, 0]
        return values - torch.einsum("vij,j->vi", modes, mean)

    def _modes(self) -> Float[Tensor, "view 14 mode"]:
        """Six rigid motions and two stretches of all images, as far as every view refines their parameters."""
        refined = (self.sigma > 0).all(dim=0)
        stretches = [i for i in map(NAMES.index, STRETCHES) if refined[i]]
        rigid = 6 if bool(refined[:6].all()) else 0
        modes = torch.zeros(*self.sigma.shape, rigid + len(stretches), dtype=torch.float64)
        if rigid:
            modes[:, :6, :6] = torch.stack([_rigid_motion(camera) for camera in self.cameras])
        modes[:, stretches, list(range(rigid, modes.shape[-1]))] = 1
        return modes

    def _increments(self) -> Float[Tensor, "view 14"]:
        """Increments for finite differences, which move rays by about STEP_PX."""
        increments = torch.full_like(self.sigma, 1e-2)
        centre = torch.tensor(self.box.centre, dtype=torch.float64)
        for v, camera in enumerate(self.cameras):
            pixel, depth = float(camera.pixel_size(centre)), abs(float(camera.local(centre)[2]))
            across, shift = float(self._half[v]) * pixel, STEP_PX * pixel
            toward = shift * depth / across if camera.projection.shows_depth else shift
            turn = shift / max(depth, across)
            zoom, away = shift / across, shift * depth / across
            increments[v, : len(GEOMETRY)] = torch.tensor([turn, turn, zoom, shift, shift, toward, zoom, away])
        return increments

    def _offset(self, values: Float[Tensor, "view 14"], rays: Rays) -> Tensor | None:
        """Displacement of the images at the pixels of rays, px; None if it is not refined."""
        if not any(i >= len(GEOMETRY) for i in self.columns):
            return None
        view = rays.view.long()
        middle, half = self._middle.to(rays.pixel)[view], self._half.to(rays.pixel)[view]
        image = values[:, len(GEOMETRY) :].to(rays.pixel)[view]
        return displaced(image, (rays.pixel - middle) / half[:, None]).to(rays.near)


def _rigid_motion(camera: Camera) -> Float[Tensor, "6 6"]:
    """Derivative of the parameters of a camera by a rotation (rad) and translation (mm) of the world."""
    rotation, centre = camera.rotation.double(), camera.centre.double()
    x, y, z = centre.tolist()
    cross = torch.tensor([[0, z, -y], [-z, 0, x], [y, -x, 0]], dtype=torch.float64)  # w -> w x C
    motion = torch.zeros(6, 6, dtype=torch.float64)
    motion[:3, :3] = -rotation
    motion[3:, :3], motion[3:, 3:] = rotation @ cross, rotation
    return motion


def random_pixels(target: Target, views: int, seed: int, per_view: int = PIXELS) -> list[TechniqueData]:
    """Draw about `per_view` pixels of each of the views of a target, with residuals in units of sigma."""
    parts, generator, unit = [], torch.Generator().manual_seed(seed), math.sqrt(target.chi_square)
    for part in target.parts:
        index = torch.randperm(len(part), generator=generator)[: per_view * views]
        subset = part[index.to(part.measured.device)]
        parts.append(replace(subset, inverse_scale=subset.inverse_scale * unit, outlier=subset.outlier * unit))
    return parts


def rig_state(rig: Refinement | None) -> dict[str, Tensor]:
    """Return what a checkpoint stores of a rig, if it is refined."""
    return {} if rig is None else {f"rig.{name}": value for name, value in rig.state_dict().items()}


def load_rig(rig: Refinement | None, tensors: Mapping[str, Tensor]) -> None:
    """Load `rig_state` from the tensors of a checkpoint; both runs must refine a rig, or neither."""
    state = {name.removeprefix("rig."): value for name, value in tensors.items() if name.startswith("rig.")}
    if bool(state) != (rig is not None):
        run = "with" if state else "without"
        raise InputError(f"the checkpoint is of a run {run} --refine; give the same settings", field="refine")
    if rig is not None:
        rig.load_state_dict(state)


@torch.no_grad()
def refit(
    field: Field, measurement: Measurement, settings: Mapping[str, Any], device: torch.device | str = "cpu"
) -> list[RefinedView]:  # fmt: skip
    """Return the table of the refined parameters of views, such as withheld ones, against a fixed field.

    It is empty for images without displacements, whose brightness is unknown.
    """
    measurement = of_source(measurement, "auto", preferred="displacements")
    if "images" in measurement.maps:
        return []
    rig = Refinement.of_table(measurement, settings, (), gauged=False)
    target = Target.of(measurement, tuple(settings["open_faces"]), linear=True).to(device)

    def predict(part: TechniqueData, rays: Rays) -> Tensor:
        return project(PathIntegral(part.model, REFIT_SAMPLES), field, rays, device)

    for i in range(REFIT_STEPS):
        pixels = random_pixels(target, len(measurement.names), i, REFIT_PIXELS)
        rig.step(pixels, predict, target.sigma_known, momentum=0.0)
    return rig.table()


def with_rig(measurement: Measurement, result: Reconstruction) -> Measurement:
    """Return a measurement with the cameras of a result; those of views it did not use are refined against its field.

    Whatever compares a field with data takes them from here: a field fits its own cameras, not the calibrated ones.
    """
    table, used = list(result.rig), {row["name"] for row in result.rig}
    others = [name for name in measurement.names if name not in used]
    if table and others:
        table += refit(result.field, measurement.select(others), result.settings, result.device)
    return with_corrections(measurement, table)
