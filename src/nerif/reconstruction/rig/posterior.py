"""How well the data tell the numbers of a rig, when the field may follow: their covariance afterwards.

    S = J^T W J - J^T W F (F^T W F + P)^-1 F^T W J + Sigma^-1,      covariance = S^-1

J is what the numbers change of what was measured, F the voxels' map, on a coarse grid and bins of pixels of its size;
P the curvature of total variation about the field found, its scale that of the field's own gradients. Each column of J
is first explained by voxels as far as they can; what is left tells of the camera. W is that of
the noise, or of what is left unexplained where that is more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.data.measurement import Measurement
from nerif.fields.base import Field
from nerif.fields.grid import Boundary
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Grid, Rays
from nerif.reconstruction.gauge import ambient_faces
from nerif.reconstruction.rig.refinement import Refinement, drawn
from nerif.reconstruction.sources import of_source
from nerif.reconstruction.target import Part, Target
from nerif.reconstruction.voxels.levels import bins_of
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.problem import Penalty, Problem
from nerif.reconstruction.voxels.total_variation import at_faces, gradient_square

__all__ = ["covariance", "with_posterior"]

VOXELS, BASIS = 14, "cubic"  # along the longest edge of the box
LEAST = 1e-9  # of the mean curvature: what keeps voxels finite that no ray sees
SAMPLES = 64  # of a ray
FREEDOM = 0.01  # of that penalty: a field that stands elsewhere has as much total variation, which its curvature denies
SOFT = 0.05  # of the mean gradient: below it the penalty is quadratic


def with_posterior(
    table: Sequence[dict[str, Any]], measurement: Measurement, field: Field, settings: Mapping[str, Any],
    on_voxel: Callable[[int, int], None] = lambda done, total: None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return a table of refined numbers with their standard deviations afterwards, and what is left of each view.

    `sigma_after` are these; `aside_sigma_px` is by how much what a view shows of the middle of the box may stand
    elsewhere, in the worse direction; `told` is 1 less the share of it beforehand that is left; `rms_before` and
    `rms_after` are the residuals over sigma as calibrated and as refined, both against the field that was found.

    Parameters
    ----------
    table : of the views of the measurement (Refinement.table)
    measurement : with the cameras as calibrated
    field : that was found
    settings : of the reconstruction
    on_voxel : told how many voxels are done, the bulk of the work
    """
    measurement = of_source(measurement, "auto", preferred="displacements")
    rig, faces = Refinement.of_table(measurement, settings, table), tuple(settings["open_faces"])
    found = covariance(rig, measurement, field, faces, on_voxel)
    there = residuals(rig, measurement, field, faces)
    rig.restore({**rig.kept(), "values": torch.zeros_like(rig.values)})
    before = residuals(rig, measurement, field, faces)
    k, rows = len(rig.columns), list[dict[str, Any]]()
    for row in table:
        if row["name"] not in rig.names:  # displacements tell nothing of a view that has none
            rows.append(row)
            continue
        v = rig.names.index(row["name"])
        own = found[v * k : (v + 1) * k, v * k : (v + 1) * k]
        after = own.diagonal().clamp(min=0).sqrt() * rig.sigma[v, rig.columns]
        look = rig.aside(v) * rig.sigma[v, rig.columns]  # px by a standard deviation of each number
        there_px, before_px = look @ own @ look.T, look @ look.T
        share = torch.linalg.eigvals(torch.linalg.pinv(before_px, hermitian=True) @ there_px).real.max()
        named = dict(zip(row["values"], after.tolist(), strict=True))
        left = {"rms_before": float(before[v]), "rms_after": float(there[v])} if _sigma_known(measurement) else {}
        aside = float(torch.linalg.eigvalsh(there_px)[-1].clamp(min=0).sqrt())
        told = 1 - float(share.clamp(0, 1).sqrt())
        rows.append({**row, "told": told, "aside_sigma_px": aside, "sigma_after": named, **left})
    return rows


def _sigma_known(measurement: Measurement) -> bool:
    """Whether the noise of all that was measured is known."""
    return all(o.sigma is not None for o in measurement.observations)


def covariance(
    rig: Refinement, measurement: Measurement, field: Field, open_faces: tuple[str, ...] = (),
    on_voxel: Callable[[int, int], None] = lambda done, total: None, voxels: int | None = None,
) -> Float[Tensor, "m m"]:  # fmt: skip
    """Return the covariance of all refined numbers in units of their sigmas, view by view in the order of its columns.

    Parameters
    ----------
    rig : as refined
    measurement : with the cameras as calibrated
    field : that was found with it
    open_faces : faces whose rays are dropped
    on_voxel : told how many voxels are done, the bulk of the work
    voxels : along the longest edge of the box, on which the field follows; None for VOXELS
    """
    grid = Grid.of_resolution(measurement.box, voxels or VOXELS)
    target = Target.of(measurement, open_faces, bins_of(measurement, grid), linear=True).without_outliers()
    target = replace(target, parts=tuple(part.to("cpu") for part in target.parts))
    boundary = Boundary(ambient_faces(measurement, ()))
    moved = tuple(rig.of(part) for part in target.parts)
    operators = [VoxelOperator(part.rays, grid, part.model, BASIS, boundary) for part in moved]
    problem = Problem(operators, replace(target, parts=moved))
    coefficients = problem.zero() + field.sample(grid, "cpu") / target.scale

    def predict(part: Part, rays: Rays) -> Tensor:
        operator = next(o for o, p in zip(operators, target.parts, strict=True) if p.model is part.model)
        return operator.for_rays(rays, part.model)(coefficients * target.scale)

    found = [rig.slopes(part, predict) for part in target.parts]
    views, k = len(rig.cameras), len(rig.columns)
    root = math.sqrt(target.numbers)
    columns = torch.zeros(problem.data.numel(), views * k, dtype=torch.float64)
    first = 0
    for part, (_, slopes) in zip(target.parts, found, strict=True):
        view = part.rays.view.long().cpu()
        own = slopes * rig.sigma[:, rig.columns][view][:, None] / root  # (n, c, k)
        rows = first + torch.arange(own.shape[0] * own.shape[1]).reshape(own.shape[:2])
        for i in range(k):
            columns[rows, (view * k + i)[:, None]] = own[:, :, i]
        first += rows.numel()
    level = max(1.0, float(residuals(rig, measurement, field, open_faces).square().mean()))
    unit = level / (target.numbers * target.chi_square)  # of one chi-square in the problem's objective
    magnitude = gradient_square(problem.differences(coefficients)).sqrt()
    scale = float(magnitude.mean()) / 3  # of gradients with the density exp(-|g| / scale) in three dimensions
    soft = (magnitude.square() + (SOFT * float(magnitude.mean())) ** 2).sqrt()
    penalty = Penalty(problem, "gradient", at_faces(1 / (scale * soft)))
    weight = FREEDOM * unit * problem.voxels
    response, curvature = _matrices(problem, penalty, on_voxel)
    normal = response.T @ response + weight * curvature
    normal.diagonal().add_(LEAST * float(normal.diagonal().mean()))
    follows = torch.cholesky_solve(response.T @ columns, torch.linalg.cholesky(normal))
    left = columns - response @ follows
    told = (columns.T @ left) / unit
    told = 0.5 * (told + told.T)
    values, ways = torch.linalg.eigh(told)
    return (ways / (1 + values.clamp(min=0))) @ ways.T


def _matrices(
    problem: Problem, penalty: Penalty, on_voxel: Callable[[int, int], None]
) -> tuple[Float[Tensor, "n m"], Float[Tensor, "m m"]]:
    """F and L^T L as matrices, column by column."""
    response = torch.empty(problem.data.numel(), problem.voxels, dtype=torch.float64)
    curvature = torch.empty(problem.voxels, problem.voxels, dtype=torch.float64)
    voxel = problem.zero()
    for i in range(problem.voxels):
        voxel.view(-1)[i] = 1
        response[:, i] = problem.forward(voxel)
        curvature[:, i] = penalty.adjoint(penalty(voxel)).flatten()
        voxel.view(-1)[i] = 0
        on_voxel(i + 1, problem.voxels)
    return response, curvature


@torch.no_grad()
def residuals(
    rig: Refinement, measurement: Measurement, field: Field, open_faces: tuple[str, ...] = ()
) -> Float[Tensor, " view"]:
    """Return the rms over sigma of what a field leaves of some pixels of each view; NaN where there are none."""
    total = torch.zeros(len(rig.cameras), dtype=torch.float64)
    count = torch.zeros_like(total)
    for part in drawn(Target.of(measurement, open_faces, linear=True), len(rig.cameras), 0):
        there = rig.of(part)
        found = there.residual(project(PathIntegral(part.model.integral, SAMPLES), field, there.rays))
        view = part.rays.view.long()
        total.index_add_(0, view, found.double().square().sum(-1))
        count.index_add_(0, view, torch.full_like(view, found.shape[1], dtype=torch.float64))
    return (total / count).sqrt()
