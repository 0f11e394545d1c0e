"""A rig refined together with the field: where cameras stand and look, and what shifts their images.

    d = A(theta_v) f + c_v + C_v x        theta_v: corrections of camera v (geometry/pose.py), x in the image
    min  sum |d - measured|^2 / sigma^2 + sum theta^2 / sigma_theta^2

Every number is held by its standard deviation. A step is one of Gauss and Newton against the field as it is, camera by
camera; between two steps the field follows. It follows cameras so well that a step sees but a part of what is wrong, so
that steps of those gather momentum; shifts of images are seen whole. What the field follows for good, a rigid motion
of all cameras and a stretch of all images alike, is taken out: the mean of the corrections, weighted by their priors,
stays 0.

While the field is not found yet, what it leaves is alike around and no noise. So data count little at first, and where
they tell less than the prior does, the prior holds (docs/refinement.md).
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
from nerif.geometry import Box, Camera, Rays
from nerif.geometry.pose import GEOMETRY, Corrections
from nerif.reconstruction.rig.numbers import NAMES, REFINED, displaced, prior, refined_words
from nerif.reconstruction.target import Part, Target

__all__ = ["MOMENTUM", "Refinement", "drawn"]

STEP_PX = 0.3  # by which rays move at the middle of the box, to see what changes
ALIKE = 20.0  # neighbours that what is not understood is alike in
MOMENTUM = 0.6
DRAWN = 150  # pixels a view, for a step
SIGN, SIGNS = 0.012, 2  # share of a residual that a number explains, and how often, before cameras are moved
STRETCHED = ("u_x", "v_y")  # of all images alike: as a field that is a parabola across, or along the axis, does it
UNTOLD = 0.05  # share that a movement has in the mean of all which no data tell

Predict = Callable[[Part, Rays], Float[Tensor, "n k"]]
"""Gives the path integral of the field that is there, along rays of a part."""


class Refinement:
    """The refined numbers of a rig.

    Parameters
    ----------
    cameras : as they were calibrated
    box : of the field, mm
    sigma : (view, 14) standard deviation of each of NAMES; 0 for one that is not refined
    gauged : whether the field follows, so that what it can follow for good has to be taken out
    """

    def __init__(
        self, cameras: Sequence[Camera], box: Box, sigma: Float[Tensor, "view 14"], gauged: bool = True
    ) -> None:
        self.cameras, self.box, self.sigma, self.gauged = tuple(cameras), box, sigma.double(), gauged
        self.values, self.velocity = torch.zeros_like(self.sigma), torch.zeros_like(self.sigma)
        self.done = 0
        """Steps in this cycle of a run."""
        self.signs = 0
        """How often in a row the data have shown that the rig is off; from SIGNS on it counts as off."""
        self.explained = torch.zeros(len(self.cameras), dtype=torch.float64)
        """Share of the residual of each view that its numbers would explain, beyond what they would of noise."""
        self.columns = [i for i in range(len(NAMES)) if bool((self.sigma[:, i] > 0).any())]
        self._half = torch.tensor([max(c.image_size) / 2 for c in self.cameras])
        self._middle = torch.tensor([[(n - 1) / 2 for n in c.image_size[::-1]] for c in self.cameras])
        self._corrections = self._of(self.values)

    @classmethod
    def asked(
        cls, measurement: Measurement, refine: Sequence[str], mm: float | None = None, deg: float | None = None,
        px: float = 0.05, gauged: bool = True,
    ) -> Refinement:  # fmt: skip
        """Return the refinement of some of REFINED.

        Parameters
        ----------
        mm, deg : standard deviations of where cameras stand and how they are turned; None for those that the cameras
            know of themselves, or POSE_SIGMA where they do not
        px : by how much images are shifted
        gauged : as for the class

        Raises
        ------
        InputError
            If nothing measured can tell of a shift.
        """
        words = refined_words(refine)
        whole = torch.stack([prior(camera, mm, deg, px) for camera in measurement.cameras])
        if "cameras" in words and not bool(whole[:, :6].any()):
            raise InputError(
                "expected some standard deviations above 0 to refine cameras, got none", field="pose_sigma"
            )
        if "shift" in words and any(not kind.windowed for kind in measurement.techniques):
            names = " and ".join(o.technique.measured for o in measurement.observations)
            raise InputError(
                f"expected displacements alone for 'shift', got {names}; of images give --from displacements",
                field="refine",
            )
        if "background" in words and any(camera.background is None for camera in measurement.cameras):
            raise InputError(
                "expected cameras that look at a background for 'background', got some without", field="refine"
            )
        open_ = torch.zeros(len(NAMES), dtype=torch.bool)
        for word in words:
            open_[list(REFINED[word])] = True
        return cls(measurement.cameras, measurement.box, torch.where(open_, whole, 0.0), gauged)

    @classmethod
    def of_table(
        cls, measurement: Measurement, settings: Mapping[str, Any], table: Sequence[dict[str, Any]], gauged: bool = True
    ) -> Refinement:
        """Return the refinement that settings ask for, at the numbers of a table.

        Parameters
        ----------
        settings : refine, pose_sigma_mm, pose_sigma_deg and shift_sigma_px, by their names
        table : of the views of the measurement, and perhaps of others
        """
        sigma = (settings["pose_sigma_mm"], settings["pose_sigma_deg"], settings["shift_sigma_px"])
        found = cls.asked(measurement, settings["refine"], *sigma, gauged=gauged)
        rows = {row["name"]: row["values"] for row in table}
        for v, view in enumerate(found.names):
            for name, value in rows.get(view, {}).items():
                found.values[v, NAMES.index(name)] = value
        found._corrections = found._of(found.values)
        return found

    # -- what follows from the numbers ---------------------------------------------------------------------------

    @property
    def corrected(self) -> tuple[Camera, ...]:
        """The cameras as refined."""
        return self._corrections.corrected

    @property
    def off(self) -> bool:
        """Whether data have shown that the rig is off."""
        return self.signs >= SIGNS

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the views."""
        return tuple(camera.name for camera in self.cameras)

    def of(self, part: Part, numbers: Sequence[int] | None = None) -> Part:
        """Return a part with its rays as the refined cameras have them, and the displacement of its images.

        Parameters
        ----------
        numbers : of the cameras that are the views of the part; None where they are all
        """
        rays = part.rays
        if numbers is not None and list(numbers) != list(range(len(self.cameras))):
            rays = replace(rays, view=torch.tensor(numbers, device=rays.view.device).to(rays.view)[rays.view.long()])
        geometric = any(i < len(GEOMETRY) for i in self.columns)
        moved = self._corrections.apply(rays, self.box) if geometric else rays
        return replace(part, rays=replace(moved, view=part.rays.view), offset=self._offset(self.values, rays))

    def table(self) -> list[dict[str, Any]]:
        """Return for each view the refined numbers by their names, and how far it moved: by how many pixels what it
        shows of the middle of the box did, and in sigmas, those of that or of the number that moved furthest.
        """
        rows = []
        for v, (camera, after) in enumerate(zip(self.cameras, self.corrected, strict=True)):
            value, sigma = self.values[v], self.sigma[v]
            aside = self._middle_at(after) - self._middle_at(camera) + value[len(GEOMETRY) :][:2]
            held = self.aside(v) * sigma[self.columns]
            looks = float((aside @ torch.linalg.pinv(held @ held.T, hermitian=True) @ aside).clamp(min=0).sqrt())
            most = max((abs(float(value[i] / sigma[i])) for i in self.columns if sigma[i] > 0), default=0.0)
            row = {"name": camera.name, "moved": max(most, looks), "aside_px": float(aside.norm())}
            numbers = {NAMES[i]: float(value[i]) for i in self.columns}
            rows.append({**row, "values": numbers, "sigma": {NAMES[i]: float(sigma[i]) for i in self.columns}})
        return rows

    def aside(self, view: int) -> Float[Tensor, "2 k"]:
        """Return by how many pixels what a view shows of the middle of the box moves with each number refined of it."""
        steps, slopes = self._steps()[view], []
        here = self._middle_at(self.cameras[view])
        for i in self.columns:
            change = torch.zeros(len(NAMES), dtype=torch.float64)
            change[i] = steps[i]
            moved = Corrections(self.cameras[view : view + 1], change[None, : len(GEOMETRY)]).corrected[0]
            slopes.append((self._middle_at(moved) - here + change[len(GEOMETRY) :][:2]) / steps[i])
        return torch.stack(slopes, dim=1)

    def _middle_at(self, camera: Camera) -> Float[Tensor, 2]:
        """Where a camera shows the middle of the box, px."""
        return camera.project(torch.tensor([self.box.centre], dtype=camera.rotation.dtype))[0].double()

    # -- steps ---------------------------------------------------------------------------------------------------

    def step(
        self, parts: Sequence[Part], predict: Predict, known: bool = True, momentum: float = MOMENTUM, ask: float = 0.0
    ) -> None:  # fmt: skip
        """Move by one step of Gauss and Newton, and a share of the step before, to what some pixels ask for.

        Parameters
        ----------
        parts : pixels, with their calibrated rays, residuals in units of sigma
        predict : of the field
        known : whether sigma is; else residuals are in any unit
        ask : above 0, move nothing before the data have shown that the rig is off by that many times the share SIGN for
            each number: what an unfinished field leaves moves it too
        """
        self.done += 1
        if not parts:
            return
        normal, right = self.normal_equations(parts, predict, known)
        if ask and not self.off:
            sign = float(self.explained.median()) > ask * SIGN * len(self.columns)
            self.signs = self.signs + 1 if sign else 0
            if not self.off:
                return
        sigma = self.sigma[:, self.columns]  # 0 of a number that a view does not refine: it stays
        told, ways = torch.linalg.eigh(sigma[:, :, None] * normal * sigma[:, None])
        pull = torch.einsum("vij,vi->vj", ways, sigma * right)
        at = torch.einsum("vij,vi->vj", ways, self.values[:, self.columns] / sigma.clamp(min=1e-30))
        told = told.clamp(min=0)
        move = ((1 + told) * pull - at) / (1 + told * (1 + told))  # what is told clearly is free of the prior
        change = torch.zeros_like(self.values)
        change[:, self.columns] = sigma * torch.einsum("vij,vj->vi", ways, move)
        gathered = momentum * self.velocity
        gathered[:, len(GEOMETRY) :] = 0
        self.velocity = gathered + change
        counts = (told / (1 + told)).clamp(min=UNTOLD).sqrt()[:, :, None] * ways.mT
        self.values = self._centred(self.values + self.velocity, counts)
        self._corrections = self._of(self.values)

    def normal_equations(
        self, parts: Sequence[Part], predict: Predict, known: bool = True
    ) -> tuple[Float[Tensor, "view k k"], Float[Tensor, "view k"]]:
        """Return J^T W J and -J^T W r of each view, of the numbers that are refined."""
        views, k = len(self.cameras), len(self.columns)
        normal = torch.zeros(views, k, k, dtype=torch.float64)
        right = torch.zeros(views, k, dtype=torch.float64)
        fits = torch.zeros(views, 4, dtype=torch.float64)  # squares explained, all, numbers that explain them, and all
        for part in parts:
            now, jacobian = self.slopes(part, predict)
            view = part.rays.view.long().cpu()
            weight = (part.outlier / now.abs().clamp(min=1e-30)).clamp(max=1.0)
            for v in range(views):
                own = view == v
                if not bool(own.any()):
                    continue
                j, r, w = jacobian[own].flatten(0, 1), now[own].flatten(), weight[own].flatten()
                level = float((w * r.square()).mean())
                level, excess = (max(level, 1.0), max(level - 1, 0.0)) if known else (max(level, 1e-30), 1.0)
                each = 1 / (level * (1 + ALIKE * min(excess, 1.0)))
                fitted = torch.linalg.lstsq(w.sqrt()[:, None] * j, w.sqrt() * r).solution
                squares = (w.sqrt() * (j @ fitted)).square().sum(), (w * r.square()).sum()
                fits[v] += torch.stack([*squares, *torch.tensor([k, len(r)], dtype=torch.float64)])
                normal[v] += each * (j.T * w) @ j
                right[v] -= each * (j.T * w) @ r
        explained, whole, numbers, of = fits.clamp(min=1e-30).unbind(dim=1)
        self.explained = explained / whole - numbers / of
        return normal, right

    def slopes(self, part: Part, predict: Predict) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n c k"]]:
        """Return the residual of a part, and what the numbers that are refined change of it, each by its unit."""
        steps = self._steps()
        now, seen = self.residual(part, self.values, predict)
        slopes = []
        for i in self.columns:
            other = self.values.clone()
            other[:, i] += steps[:, i]
            there, _ = self.residual(part, other, predict, seen if i >= len(GEOMETRY) else None)
            slopes.append((there - now) / steps[:, i].to(now)[part.rays.view.long()][:, None])
        return now.double().cpu(), torch.stack(slopes, dim=-1).double().cpu()

    def residual(
        self, part: Part, values: Float[Tensor, "view 14"], predict: Predict, seen: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the residual of a part with other numbers, outliers as large as they are, and the path integral.

        Parameters
        ----------
        part : pixels, with their calibrated rays
        seen : the path integral, where it is known
        """
        if seen is None:
            seen = predict(part, self._of(values).apply(part.rays, self.box))
        offset = self._offset(values, part.rays)
        shifted = seen if offset is None else seen + offset
        return part.model.residual(shifted, part.measured, part.rays) * part.inverse_scale, seen

    # -- what a checkpoint keeps ---------------------------------------------------------------------------------

    def kept(self) -> dict[str, Tensor]:
        """Return what a checkpoint keeps."""
        done = torch.tensor(self.done)
        kept = {"values": self.values.clone(), "velocity": self.velocity.clone(), "done": done}
        return {**kept, "signs": torch.tensor(self.signs)}

    def restore(self, kept: dict[str, Tensor]) -> None:
        """Go on from what a checkpoint kept."""
        self.values, self.velocity, self.done = kept["values"].clone(), kept["velocity"].clone(), int(kept["done"])
        self.signs = int(kept["signs"])
        self._corrections = self._of(self.values)

    def _of(self, values: Float[Tensor, "view 14"]) -> Corrections:
        return Corrections(self.cameras, values[:, : len(GEOMETRY)])

    def _centred(
        self, values: Float[Tensor, "view 14"], counts: Float[Tensor, "view k k"] | None = None
    ) -> Float[Tensor, "view 14"]:
        """The numbers without what no camera tells: the mean of `_modes`, every number as clearly as it is told.

        Parameters
        ----------
        counts : movements in units of sigma to what counts of them; None for all alike
        """
        modes = self._modes()
        if not self.gauged or not modes.shape[-1]:
            return values
        sigma = self.sigma[:, self.columns].clamp(min=1e-30)
        scaled = modes[:, self.columns] / sigma[..., None]
        if counts is None:
            counts = torch.eye(len(self.columns), dtype=torch.float64).expand(len(self.cameras), -1, -1)
        moved = counts @ (values[:, self.columns] / sigma)[..., None]
        best = torch.linalg.lstsq((counts @ scaled).flatten(0, 1), moved.flatten(0, 1)).solution[:, 0]
        return values - torch.einsum("vij,j->vi", modes, best)

    def _modes(self) -> Float[Tensor, "view 14 mode"]:
        """What the field follows: six rigid motions, and images that all stretch alike, along columns or along rows.

        Only those of which every view refines every number.
        """
        refined = (self.sigma > 0).all(dim=0)
        stretched = [i for i in map(NAMES.index, STRETCHED) if refined[i]]
        rigid = 6 if bool(refined[:6].all()) else 0
        modes = torch.zeros(*self.sigma.shape, rigid + len(stretched), dtype=torch.float64)
        if rigid:
            modes[:, :6, :6] = torch.stack([_motion(camera) for camera in self.cameras])
        modes[:, stretched, list(range(rigid, modes.shape[-1]))] = 1
        return modes

    def _steps(self) -> Float[Tensor, "view 14"]:
        """By how much each number is changed to see what it does: what moves rays by STEP_PX, at about."""
        steps = torch.full_like(self.sigma, 1e-2)
        centre = torch.tensor(self.box.centre, dtype=torch.float64)
        for v, camera in enumerate(self.cameras):
            pixel, depth = float(camera.pixel_size(centre)), abs(float(camera.local(centre)[2]))
            across, moved = float(self._half[v]) * pixel, STEP_PX * pixel
            toward = moved * depth / across if camera.projection.shows_depth else moved
            turn = moved / max(depth, across)
            zoom, away = moved / across, moved * depth / across
            steps[v, : len(GEOMETRY)] = torch.tensor([turn, turn, zoom, moved, moved, toward, zoom, away])
        return steps

    def _offset(self, values: Float[Tensor, "view 14"], rays: Rays) -> Tensor | None:
        """The displacement of the images at the pixels of rays, px; None where it is not refined."""
        if not any(i >= len(GEOMETRY) for i in self.columns):
            return None
        view = rays.view.long()
        middle, half = self._middle.to(rays.pixel)[view], self._half.to(rays.pixel)[view]
        return displaced(values[:, len(GEOMETRY) :].to(rays.pixel)[view], (rays.pixel - middle) / half[:, None]).to(
            rays.near
        )


def drawn(target: Target, views: int, seed: int, each: int = DRAWN) -> list[Part]:
    """Draw some pixels of a target, residuals in units of sigma, for a step.

    Parameters
    ----------
    views : that the target has
    each : pixels of a view, about
    """
    parts, generator, unit = [], torch.Generator().manual_seed(seed), math.sqrt(target.chi_square)
    for part in target.parts:
        index = torch.randperm(len(part), generator=generator)[: each * views]
        some = part[index.to(part.measured.device)]
        parts.append(replace(some, inverse_scale=some.inverse_scale * unit, outlier=some.outlier * unit))
    return parts


def _motion(camera: Camera) -> Float[Tensor, "6 6"]:
    """How the numbers of a camera change with a rigid motion of the world, turn (rad) and shift (mm)."""
    rotation, centre = camera.rotation.double(), camera.centre.double()
    x, y, z = centre.tolist()
    cross = torch.tensor([[0, z, -y], [-z, 0, x], [y, -x, 0]], dtype=torch.float64)  # w -> w x C
    motion = torch.zeros(6, 6, dtype=torch.float64)
    motion[:3, :3] = -rotation
    motion[3:, :3], motion[3:, 3:] = rotation @ cross, rotation
    return motion
