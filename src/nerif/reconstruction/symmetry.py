"""The symmetry axis of a reconstruction: as given, or estimated together with the field on a coarse grid.

    min  |A(t) c - y|^2 / sigma^2 + weight |L c|^2 + |t / t_sigma|^2,     t = (shift, tilt) towards e1 and e2

by Gauss-Newton steps in the coefficients c and the axis t. With N the normal matrix,
covariance of t = (N_tt - N_tc N_cc^-1 N_ct)^-1.

An axis in the wrong place leaves an antisymmetric residual, so a few steps determine shift and tilt in the image plane.
e1 is perpendicular to the viewing direction. Where all cameras look along e2, shift and tilt towards them cannot be
determined and are kept as given.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.geometry.symmetry import Axis, Symmetry, parse_symmetry
from nerif.reconstruction.gauge import ambient_faces
from nerif.reconstruction.shared_settings import SharedSettings
from nerif.reconstruction.sources import of_source
from nerif.reconstruction.target import Target
from nerif.reconstruction.voxels.layout import Symmetric
from nerif.reconstruction.voxels.levels import bins_of
from nerif.reconstruction.voxels.problem import Penalty, Problem
from nerif.reconstruction.voxels.symmetric_operator import SymmetricOperator

__all__ = ["axis_of", "check_views", "find_axis", "symmetry_asked", "with_axis"]

VOXELS = 40  # along the longest edge of the box
MOST_RAYS = 6000  # by which it is found
STEPS = 12
ENOUGH = 0.02  # standard deviations, of a last step
WEIGHT = 1e-4  # of the penalty: far below what keeps noise out, so that it pulls at no axis
NUDGE = 1e-3  # of the longest edge of the box, for differences
ACROSS = math.sin(math.radians(15)) ** 2  # mean square of a direction's share across the views, from which they tell it


def find_axis(
    measurement: Measurement, symmetry: Symmetry, sigma: tuple[float, float], faces: tuple[str, ...],
    open_faces: tuple[str, ...] = (),
) -> Axis:  # fmt: skip
    """Find the axis of a flow near the one given.

    Parameters
    ----------
    measurement : Measurement
    symmetry : about the axis as it is named
    sigma : standard deviations of its place (mm) and of its direction (rad) to each side; 0 for what is certain
    faces : of the box on which the field is ambient
    open_faces : whose rays are left out
    """
    symmetry, across = _across(measurement, symmetry)
    before = (sigma[0], sigma[0], sigma[1], sigma[1])
    refined = [i for i, s in enumerate(before) if s > 0 and across[i % 2] > ACROSS]
    still = replace(symmetry, harmonics=0)
    values = torch.zeros(4, dtype=torch.float64)
    if not refined:
        return Axis(symmetry, tuple(values.tolist()), before, before, math.nan)
    layout = Symmetric(measurement.box, faces, "cubic", still)
    grid = layout.grid(VOXELS)
    target = Target.of(measurement, open_faces, bins_of(measurement, grid), linear=True).without_outliers().to("cpu")
    if len(target) > MOST_RAYS:
        chosen = torch.randperm(len(target), generator=torch.Generator().manual_seed(0))[:MOST_RAYS]
        target = target[chosen]
    scales = torch.tensor([before[i] for i in refined], dtype=torch.float64)
    edge = max(measurement.box.edges)
    nudges = torch.tensor([NUDGE * edge] * 2 + [NUDGE] * 2, dtype=torch.float64)
    penalty: Tensor | None = None

    def about(v: Float[Tensor, " 4"]) -> Symmetry:
        a, b, c, d = v.tolist()
        return still.move((a, b), (c, d))

    def operators(v: Float[Tensor, " 4"]) -> list[SymmetricOperator]:
        moved = about(v)
        return [
            SymmetricOperator(moved, p.rays, grid, p.model, "cubic", layout.boundary, dtype=torch.float64)
            for p in target.parts
        ]

    def seen(v: Float[Tensor, " 4"], c: Tensor) -> Tensor:
        x = c.reshape(grid.shape)
        each = [o(x) * p.inverse_scale for o, p in zip(operators(v), target.parts, strict=True)]
        return torch.cat([e.flatten() for e in each]).double()

    data = torch.cat([(p.of_field * p.inverse_scale).flatten() for p in target.parts]).double()
    c = torch.zeros(math.prod(grid.shape), dtype=torch.float64)
    for _ in range(STEPS):
        here = operators(values)
        if penalty is None:
            problem = Problem(here, target)
            penalty = _squares(Penalty(problem, "gradient")) / target.scale**2 * WEIGHT * target.numbers
        rows = torch.cat(
            [
                (o.matrix() * p.inverse_scale[..., None]).flatten(0, 1).double()
                for o, p in zip(here, target.parts, strict=True)
            ]
        )
        normal = rows.T @ rows + penalty
        factor = torch.linalg.cholesky(normal + 1e-12 * normal.diagonal().mean() * torch.eye(len(normal)))
        c = torch.cholesky_solve((rows.T @ data)[:, None], factor)[:, 0]
        left = data - rows @ c
        columns = []
        for i in refined:
            nudge = torch.zeros(4, dtype=torch.float64)
            nudge[i] = nudges[i]
            columns.append((seen(values + nudge, c) - seen(values - nudge, c)) / (2 * nudges[i]))
        slopes = torch.stack(columns, dim=1) * scales
        aside = slopes - rows @ torch.cholesky_solve(rows.T @ slopes, factor)
        # one over the square of the noise in these units; what is left beside it counts as noise as well
        level = float(left.square().mean())
        noise = max(1 / target.chi_square if target.sigma_known else 0.0, level)
        curvature = slopes.T @ aside / noise + torch.eye(len(refined))
        pull = aside.T @ left / noise - values[refined] / scales
        step = torch.linalg.solve(curvature, pull)
        values[refined] += step * scales
        after = torch.linalg.inv(curvature).diagonal().sqrt()
        if bool((step.abs() < ENOUGH * after).all()):
            break
    sigma_after = torch.tensor(before, dtype=torch.float64)
    sigma_after[refined] = after * scales
    found = replace(about(values), harmonics=symmetry.harmonics)
    unit = math.sqrt(target.chi_square) if target.sigma_known else 1.0
    return Axis(found, tuple(values.tolist()), before, tuple(sigma_after.tolist()), math.sqrt(level) * unit)


def _across(measurement: Measurement, symmetry: Symmetry) -> tuple[Symmetry, tuple[float, float]]:
    """The symmetry with e1 across the views, and how much of e1 and e2 is across them, mean square."""
    frame = symmetry.matrix
    looks = torch.stack([camera.rotation[2].double() for camera in measurement.cameras]) @ frame[:2].T
    looks = looks / looks.norm(dim=1, keepdim=True).clamp_min(1e-9)
    shares, ways = torch.linalg.eigh(looks.T @ looks / len(looks))  # e1 is looked along least
    e1 = ways[:, 0] @ frame[:2]
    e1 = e1 * torch.sign(e1[e1.abs().argmax()])
    rows = torch.stack([e1, torch.linalg.cross(frame[2], e1), frame[2]]).tolist()
    return replace(symmetry, frame=tuple((a, b, c) for a, b, c in rows)), (1 - float(shares[0]), 1 - float(shares[1]))


def _squares(penalty: Penalty) -> Float[Tensor, "m m"]:
    """L^T L as a matrix."""
    problem = penalty.problem
    rows = torch.empty(problem.voxels, problem.voxels, dtype=torch.float64)
    one = problem.zero()
    for i in range(problem.voxels):
        one.view(-1)[i] = 1
        rows[i] = penalty.adjoint(penalty(one)).flatten()
        one.view(-1)[i] = 0
    return rows


Asked = TypeVar("Asked", bound=SharedSettings)

PLACE = 0.03  # of the longest edge of the box: standard deviation of where an axis is, if nothing is said
ROUNDING = 0.002  # of the longest edge of the box: within this of the axis a field is round


def symmetry_asked(settings: SharedSettings, measurement: Measurement) -> Symmetry | None:
    """Return the symmetry about the axis as it is named."""
    parsed = parse_symmetry(settings.symmetry)
    if parsed is None:
        return None
    box = measurement.box
    direction = settings.axis_direction
    if direction is None:
        direction = (0.0, 0.0, 1.0) if parsed[0] == "axis" else _looked_along(measurement)
    point = box.centre if settings.axis_point is None else settings.axis_point
    return Symmetry.about(settings.symmetry, point, direction, ROUNDING * max(box.edges))


def check_views(settings: SharedSettings, measurement: Measurement) -> None:
    """Refuse more harmonics than the views could tell: 2 N + 1 functions of (r, h), of which a view tells two.

    Raises
    ------
    InputError
        If there are N views or fewer.
    """
    parsed, views = parse_symmetry(settings.symmetry), len(measurement.cameras)
    if parsed is not None and parsed[1] >= views:
        most = "axis" if views == 1 else f"axis+{views - 1}"
        raise InputError(
            f"expected {parsed[1] + 1} views or more for {settings.symmetry}, better {2 * parsed[1] + 1}, "
            f"got {views}; give --symmetry {most}",
            field="symmetry",
        )


def axis_of(settings: SharedSettings, measurement: Measurement) -> Axis | None:
    """Return the symmetry about the axis as it is found near the one named; None where none is asked for.

    A planar flow's line, and an axis whose standard deviations are 0, are as they are named.
    """
    symmetry = symmetry_asked(settings, measurement)
    if symmetry is None:
        return None
    mm = settings.axis_sigma_mm
    mm = PLACE * max(measurement.box.edges) if mm is None else mm
    sigma = (mm, math.radians(settings.axis_sigma_deg))
    if not symmetry.axial or not any(sigma):
        return Axis(symmetry, (0.0,) * 4, (0.0,) * 4, (0.0,) * 4, math.nan)
    seen = of_source(measurement, "auto", preferred="displacements")
    faces = ambient_faces(measurement, settings.ambient_faces)
    return find_axis(seen, symmetry, sigma, faces, settings.open_faces)


def with_axis(settings: Asked, symmetry: Symmetry) -> Asked:
    """Return settings that take the axis of a symmetry that was found as given."""
    return replace(
        settings, axis_point=symmetry.point, axis_direction=symmetry.direction, axis_sigma_mm=0.0, axis_sigma_deg=0.0
    )


def _looked_along(measurement: Measurement) -> tuple[float, float, float]:
    """The edge of the box along which the cameras look most."""
    looks = torch.stack([camera.rotation[2].double() for camera in measurement.cameras])
    x, y, z = torch.eye(3)[int(looks.square().sum(dim=0).argmax())].tolist()
    return x, y, z
