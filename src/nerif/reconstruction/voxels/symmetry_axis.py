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
from nerif.geometry.symmetry import Axis, Symmetry
from nerif.geometry.symmetry_names import parse_symmetry
from nerif.reconstruction.gauge import with_gauge
from nerif.reconstruction.gauss_newton import AdaptingField, Information
from nerif.reconstruction.shared_settings import SharedSettings
from nerif.reconstruction.sources import of_source
from nerif.reconstruction.target import Target
from nerif.reconstruction.voxels.layout import Symmetric
from nerif.reconstruction.voxels.levels import bins_of
from nerif.reconstruction.voxels.symmetric_operator import SymmetricOperator
from nerif.reconstruction.voxels.voxel_problem import Penalty, Problem

__all__ = ["axis_of", "better_direction", "check_views", "find_axis", "symmetry_of", "too_few_views", "with_axis"]

VOXELS = 40  # along the longest edge of the box
MAX_RAYS = 6000
MAX_STEPS = 12
CONVERGED = 0.02  # standard deviations: largest change in the last step
WEIGHT = 1e-4  # of the penalty: too small to bias the axis
RIDGE = 1e-12  # of the mean curvature, for coefficients that no ray crosses
NUDGE = 1e-3  # of the longest edge of the box, or rad: step of finite differences
MIN_ACROSS = math.sin(math.radians(15)) ** 2  # mean square component in the image planes of a direction that is fitted
AXIS_SIGMA = 0.03  # of the longest edge of the box: default standard deviation of the position
MAX_RESIDUAL = 0.7  # of a coarse field about another edge of the box, over that about z
ROUNDING = 0.002  # of the longest edge of the box: radius within which the field is rounded

AnySettings = TypeVar("AnySettings", bound=SharedSettings)


def find_axis(
    measurement: Measurement, symmetry: Symmetry, sigma: tuple[float, float], faces: tuple[str, ...],
    open_faces: tuple[str, ...] = (),
) -> Axis:  # fmt: skip
    """Estimate the axis of a flow, with standard deviations of its position (mm) and direction (rad); 0 for certain."""
    symmetry, across = _across(measurement, symmetry)
    before = (sigma[0], sigma[0], sigma[1], sigma[1])
    refined = [i for i, s in enumerate(before) if s > 0 and across[i % 2] > MIN_ACROSS]
    axisymmetric = replace(symmetry, harmonics=0)
    values = torch.zeros(4, dtype=torch.float64)
    if not refined:
        return Axis(symmetry, tuple(values.tolist()), before, before, math.nan)
    layout = Symmetric(box=measurement.box, faces=faces, basis="cubic", symmetry=axisymmetric)
    grid, settings = layout.grid(VOXELS), ("cubic", layout.boundary, None, torch.float64)
    target = Target.of(measurement, open_faces, bins_of(measurement, grid), linear=True).without_outliers().to("cpu")
    if len(target) > MAX_RAYS:
        target = target[torch.randperm(len(target), generator=torch.Generator().manual_seed(0))[:MAX_RAYS]]
    scales = torch.tensor([before[i] for i in refined], dtype=torch.float64)
    edge = max(measurement.box.edges)
    nudges = torch.tensor([NUDGE * edge] * 2 + [NUDGE] * 2, dtype=torch.float64)

    def about(t: Float[Tensor, " 4"]) -> Symmetry:
        a, b, c, d = t.tolist()
        return axisymmetric.move((a, b), (c, d))

    def operators(t: Float[Tensor, " 4"]) -> list[SymmetricOperator]:
        symmetry = about(t)
        return [SymmetricOperator(symmetry, p.rays, grid, p.model, *settings) for p in target.parts]

    def project(t: Float[Tensor, " 4"], c: Tensor) -> Tensor:
        x = c.reshape(grid.shape)
        each = [o(x) * p.inverse_scale for o, p in zip(operators(t), target.parts, strict=True)]
        return torch.cat([e.flatten() for e in each]).double()

    data = torch.cat([(p.of_field * p.inverse_scale).flatten() for p in target.parts]).double()
    squares = Penalty(Problem(operators(values), target), "gradient").squares()
    penalty = squares / target.scale**2 * WEIGHT * target.numbers
    for _ in range(MAX_STEPS):
        present = zip(operators(values), target.parts, strict=True)
        matrices = [(o.matrix() * p.inverse_scale[..., None]).flatten(0, 1).double() for o, p in present]
        field = AdaptingField(torch.cat(matrices), penalty, RIDGE)
        c, residual = field.fit(data[:, None])[:, 0], field.rest(data[:, None])[:, 0]
        columns = []
        for i in refined:
            nudge = torch.zeros(4, dtype=torch.float64)
            nudge[i] = nudges[i]
            columns.append((project(values + nudge, c) - project(values - nudge, c)) / (2 * nudges[i]))
        slopes = torch.stack(columns, dim=1) * scales
        aside = field.rest(slopes)
        # variance of the noise in these units; a larger residual counts as noise, too
        level = float(residual.square().mean())
        noise = max(1 / target.chi_square if target.sigma_known else 0.0, level)
        information = Information(slopes.T @ aside / noise)
        step = information.step(aside.T @ residual / noise, values[refined] / scales)
        values[refined] += step * scales
        after = information.covariance.diagonal().sqrt()
        if bool((step.abs() < CONVERGED * after).all()):
            break
    posterior_sigma = torch.tensor(before, dtype=torch.float64)
    posterior_sigma[refined] = after * scales
    fit = replace(about(values), harmonics=symmetry.harmonics)
    unit = math.sqrt(target.chi_square) if target.sigma_known else 1.0
    return Axis(fit, tuple(values.tolist()), before, tuple(posterior_sigma.tolist()), math.sqrt(level) * unit)


def _across(measurement: Measurement, symmetry: Symmetry) -> tuple[Symmetry, tuple[float, float]]:
    """The symmetry with e1 across the views, and the mean square components of e1 and e2 in the image planes."""
    frame = symmetry.matrix
    views = _viewing_directions(measurement) @ frame[:2].T
    views = views / views.norm(dim=1, keepdim=True).clamp_min(1e-9)
    shares, ways = torch.linalg.eigh(views.T @ views / len(views))  # ascending: e1 is viewed along least
    e1 = ways[:, 0] @ frame[:2]
    e1 = e1 * torch.sign(e1[e1.abs().argmax()])
    rows = torch.stack([e1, torch.linalg.cross(frame[2], e1), frame[2]]).tolist()
    return replace(symmetry, frame=tuple((a, b, c) for a, b, c in rows)), (1 - float(shares[0]), 1 - float(shares[1]))


def _viewing_directions(measurement: Measurement) -> Float[Tensor, "view 3"]:
    return torch.stack([camera.rotation[2].double() for camera in measurement.cameras])


def symmetry_of(settings: SharedSettings, measurement: Measurement) -> Symmetry | None:
    """Return the symmetry about the axis of the settings; by default through the middle of the box.

    Default direction: z for an axis, for a planar flow the edge of the box nearest to the viewing directions.
    """
    parsed = parse_symmetry(settings.symmetry)
    if parsed is None:
        return None
    box = measurement.box
    direction = settings.axis_direction
    if direction is None and parsed[0] == "axis":
        direction = (0.0, 0.0, 1.0)
    elif direction is None:
        x, y, z = torch.eye(3)[int(_viewing_directions(measurement).square().sum(dim=0).argmax())].tolist()
        direction = (x, y, z)
    point = box.centre if settings.axis_point is None else settings.axis_point
    return Symmetry.about(settings.symmetry, point, direction, ROUNDING * max(box.edges))


def check_views(settings: SharedSettings, measurement: Measurement) -> None:
    """Raise InputError if there are no more views than harmonics.

    N harmonics are 2 N + 1 functions of (r, h), of which a view determines two.
    """
    parsed, views = parse_symmetry(settings.symmetry), len(measurement.cameras)
    if parsed is not None and parsed[1] >= views:
        raise InputError(
            f"expected {parsed[1] + 1} views or more for {settings.symmetry}, better {2 * parsed[1] + 1}, "
            f"got {views}; give --symmetry {_determined(views)}",
            field="symmetry",
        )


def too_few_views(settings: SharedSettings, measurement: Measurement) -> str:
    """Return a line on harmonics that the views do not determine; empty if they determine all."""
    parsed, views = parse_symmetry(settings.symmetry), len(measurement.cameras)
    if parsed is None or views > 2 * parsed[1]:
        return ""
    return (
        f"--symmetry {settings.symmetry}: {views} views are too few for {parsed[1]} harmonics, which need "
        f"{2 * parsed[1] + 1}; the regularisation determines the rest. Give --symmetry {_determined(views)}"
    )


def _determined(views: int) -> str:
    """Return the symmetry with the most harmonics that this number of views determines."""
    return f"axis+{(views - 1) // 2}" if views > 2 else "axis"


def better_direction(settings: SharedSettings, measurement: Measurement, axis: Axis) -> tuple[float, ...]:
    """Return the edge of the box about which a coarse field fits far better than about an axis; none if stated or best.

    An axis of no stated direction is along z; a flow along x is often symmetric about that, too, but not axisymmetric.
    """
    if settings.axis_direction is not None or not axis.symmetry.axial or math.isnan(axis.residual):
        return ()
    along = _viewing_directions(measurement).square().mean(dim=0)
    residuals = {}
    for direction, share in zip(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), along.tolist(), strict=False):
        if 1 - share > MIN_ACROSS and (other := axis_of(replace(settings, axis_direction=direction), measurement)):
            residuals[direction] = other.residual
    best = min(residuals, key=lambda d: residuals[d], default=())
    return best if best and residuals[best] < MAX_RESIDUAL * axis.residual else ()


def axis_of(settings: SharedSettings, measurement: Measurement) -> Axis | None:
    """Return the estimated axis of a symmetric flow, or None.

    The direction of a planar flow, and an axis whose standard deviations are 0, are as given.
    """
    symmetry = symmetry_of(settings, measurement)
    if symmetry is None:
        return None
    mm = settings.axis_sigma_mm
    mm = AXIS_SIGMA * max(measurement.box.edges) if mm is None else mm
    sigma = (mm, math.radians(settings.axis_sigma_deg))
    if not symmetry.axial or not any(sigma):
        return Axis(symmetry, (0.0,) * 4, (0.0,) * 4, (0.0,) * 4, math.nan)
    data = with_gauge(of_source(measurement, "auto", preferred="displacements"), settings)
    return find_axis(data, symmetry, sigma, data.ambient_faces, settings.open_faces)


def with_axis(settings: AnySettings, symmetry: Symmetry) -> AnySettings:
    """Return settings with the axis of a symmetry, as certain."""
    return replace(
        settings, axis_point=symmetry.point, axis_direction=symmetry.direction, axis_sigma_mm=0.0, axis_sigma_deg=0.0
    )
