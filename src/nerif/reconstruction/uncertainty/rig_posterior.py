"""Posterior covariance of the refined parameters of a rig, with a field that adapts.

    S = J^T W J - J^T W F (F^T W F + P)^-1 F^T W J + Sigma^-1,      covariance = S^-1

J is the derivative of the measurement by the parameters. F is the forward projector of voxels on a coarse grid, with
bins of pixels of its size. P is the curvature of total variation about the field, on the scale of its own gradients.
The voxels explain each column of J as far as they can; only the rest determines the camera. W is the inverse variance
of the noise, or of the residual if that is larger.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.fields.voxel_field import Boundary
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Grid
from nerif.reconstruction.gauge import ambient_faces
from nerif.reconstruction.gauss_newton import AdaptingField, Information
from nerif.reconstruction.rig_parameters import RefinedView
from nerif.reconstruction.rig_refinement import Refinement, random_pixels
from nerif.reconstruction.sources import of_source
from nerif.reconstruction.target import Target
from nerif.reconstruction.voxels.face_gradients import at_faces, gradient_square
from nerif.reconstruction.voxels.levels import bins_of
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.voxel_problem import Penalty, Problem

__all__ = ["RigPosterior", "covariance"]

VOXELS, BASIS = 14, "cubic"  # along the longest edge of the box
RIDGE = 1e-9  # of the mean curvature, for voxels that no ray crosses
SAMPLES = 64  # per ray
PENALTY_SHARE = 0.01  # of the curvature: a shifted field has the same total variation, which its curvature denies
SOFT = 0.05  # of the mean gradient, below which the penalty is quadratic

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class RigPosterior:
    """A refined rig and the uncertainty of its parameters."""

    table: list[RefinedView]
    """For each view its parameters with their posterior standard deviations, and its residuals."""
    rig: Refinement  #: the refined rig, of the views with displacements
    covariance: Float[Tensor, "m m"]  #: of all refined parameters in units of their sigmas, view by view

    @classmethod
    def of(
        cls, table: Sequence[RefinedView], measurement: Measurement, field: Field, settings: Mapping[str, Any],
        on_voxel: Progress = lambda done, total: None,
    ) -> RigPosterior:  # fmt: skip
        """Return the posterior of a rig.

        Rows of views that are not in the measurement or have no displacements are unchanged.

        Parameters
        ----------
        table : see Refinement.table
        measurement : with the calibrated cameras
        settings : of the reconstruction
        on_voxel : called with the finished and the total number of voxels
        """
        measurement = of_source(measurement, "auto", preferred="displacements")
        rig, faces = Refinement.of_table(measurement, settings, table), tuple(settings["open_faces"])
        posterior = covariance(rig, measurement, field, faces, on_voxel)
        after = residuals(rig, measurement, field, faces)
        before = residuals(Refinement.of_table(measurement, settings, ()), measurement, field, faces)
        sigma_known = all(o.sigma is not None for o in measurement.observations)
        k, rows = len(rig.columns), list[RefinedView]()
        for row in table:
            if row["name"] not in rig.names:
                rows.append(row)
                continue
            v = rig.names.index(row["name"])
            block, sigma = posterior[v * k : (v + 1) * k, v * k : (v + 1) * k], rig.sigma[v, rig.columns]
            posterior_sigma = (block.diagonal().clamp(min=0).sqrt() * sigma).tolist()
            slopes = rig.aside(v) * sigma  # px per sigma of each parameter
            after_px, before_px = slopes @ block @ slopes.T, slopes @ slopes.T
            share = torch.linalg.eigvals(torch.linalg.pinv(before_px, hermitian=True) @ after_px).real.max()
            row = {
                **row,
                "uncertainty_reduction": 1 - float(share.clamp(0, 1).sqrt()),
                "image_shift_sigma_px": float(torch.linalg.eigvalsh(after_px)[-1].clamp(min=0).sqrt()),
                "posterior_sigma": dict(zip(row["values"], posterior_sigma, strict=True)),
            }
            residual: Any = {"rms_before": float(before[v]), "rms_after": float(after[v])} if sigma_known else {}
            rows.append({**row, **residual})
        return cls(rows, rig, posterior)

    def draw(self, generator: torch.Generator) -> list[RefinedView]:
        """Return the table of a rig drawn from the posterior, with the common motions that no data determine."""
        values, directions = torch.linalg.eigh(self.covariance)
        white = torch.randn(len(values), generator=generator, dtype=torch.float64)
        rig, change = self.rig, directions @ (values.clamp(min=0).sqrt() * white)
        sigma = rig.sigma[:, rig.columns]
        parameters = rig.values[:, rig.columns] + sigma * change.reshape(sigma.shape)
        rows = dict(zip(rig.names, parameters.tolist(), strict=True))
        return [
            {**row, "values": dict(zip(row["values"], rows.get(row["name"], row["values"].values()), strict=True))}
            for row in self.table
        ]


def covariance(
    rig: Refinement, measurement: Measurement, field: Field, open_faces: tuple[str, ...] = (),
    on_voxel: Progress = lambda done, total: None, voxels: int | None = None,
) -> Float[Tensor, "m m"]:  # fmt: skip
    """Return the covariance of all refined parameters in units of their sigmas, view by view.

    Parameters
    ----------
    rig : as refined
    measurement : with the calibrated cameras
    field : reconstructed with the rig
    voxels : along the longest edge of the box, for the adapting field; None for VOXELS
    """
    grid = Grid.of_resolution(measurement.box, voxels or VOXELS)
    target = Target.of(measurement, open_faces, bins_of(measurement, grid), linear=True).without_outliers().to("cpu")
    boundary = Boundary(ambient_faces(measurement))
    corrected = tuple(rig.of(part) for part in target.parts)
    operators = [VoxelOperator(part.rays, grid, part.model, BASIS, boundary) for part in corrected]
    problem = Problem(operators, replace(target, parts=corrected))
    coefficients = problem.zero() + field.sample(grid, "cpu") / target.scale
    views, k = len(rig.cameras), len(rig.columns)
    blocks = []
    for part in target.parts:
        view = part.rays.view.long().cpu()
        slopes = rig.slopes(part, lambda part, rays: problem.predict(part, rays, coefficients))[1]
        slopes = slopes * rig.sigma[:, rig.columns][view][:, None] / math.sqrt(target.numbers)  # (n, c, k)
        of_view = torch.nn.functional.one_hot(view, views)[:, None, :, None]
        blocks.append((slopes[:, :, None] * of_view).reshape(-1, views * k))
    columns = torch.cat(blocks)
    level = max(1.0, float(residuals(rig, measurement, field, open_faces).square().mean()))
    unit = level / (target.numbers * target.chi_square)  # of one chi-square in the problem's objective
    magnitude = gradient_square(problem.differences(coefficients)).sqrt()
    scale = float(magnitude.mean()) / 3  # of gradients with the density exp(-|g| / scale) in three dimensions
    soft = (magnitude.square() + (SOFT * float(magnitude.mean())) ** 2).sqrt()
    penalty = Penalty(problem, "gradient", at_faces(1 / (scale * soft)))
    curvature = PENALTY_SHARE * unit * problem.voxels * penalty.squares()
    adapting = AdaptingField(problem.matrix(problem.forward, on_voxel), curvature, RIDGE)
    information = columns.T @ adapting.rest(columns) / unit
    return Information(0.5 * (information + information.T)).covariance


@torch.no_grad()
def residuals(
    rig: Refinement, measurement: Measurement, field: Field, open_faces: tuple[str, ...] = ()
) -> Float[Tensor, " view"]:
    """Return the residual over sigma, rms of random pixels of each view; NaN for a view without any."""
    total = torch.zeros(len(rig.cameras), dtype=torch.float64)
    count = torch.zeros_like(total)
    for part in random_pixels(Target.of(measurement, open_faces, linear=True), len(rig.cameras), 0):
        corrected = rig.of(part)
        residual = corrected.residual(project(PathIntegral(part.model, SAMPLES), field, corrected.rays))
        view = part.rays.view.long()
        total.index_add_(0, view, residual.double().square().sum(-1))
        count.index_add_(0, view, torch.full_like(view, residual.shape[1], dtype=torch.float64))
    return (total / count).sqrt()
