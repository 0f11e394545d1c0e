"""Bootstrap estimate of the error of a reconstruction, from trials on a known field: the reconstruction itself.

    std(x) = factor (G * mean_j (q'_j - q)^2)^(1/2) (x),     factor = rho exp(C sqrt(1 - k^2))
    k^2 = <(q'_j - g * q'_j)^2> / <(q - g * q)^2>,    rho^2 = <(d - F q)^2> / <(d_j - F q'_j)^2>

Trial q'_j is reconstructed from simulated projections of the field q in the same cameras, to which the residuals of the
reconstruction are added in blocks of random sign: noise of the right size and spatial correlation. The error of q'_j is
then a sample of the error of q. If the rig was refined, the cameras of q are drawn from its posterior, and the trial,
given the calibrated ones, refines a rig of its own: its error includes that of the rig, and common motions of all
cameras, which no data determine.

q is smoother than the truth, and detail that the reconstruction cannot resolve is absent from q. The loss is estimated
from the share k^2 of the detail of q that the trials retain, with g as fine as the pixels. If they retain all of it,
the errors are due to noise; if not, q has lost more of the truth than the trials have lost of q. C was fitted to
random flows (docs/decisions/055). If the reconstruction was trained longer than the trials, it fits its data d
better than they fit theirs, d_j, and its errors are smaller by rho.

No truth is used. G: deviations.py.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import mean

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.field import Field
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Camera, Grid
from nerif.geometry.body import contained
from nerif.physics.medium import Medium
from nerif.reconstruction.reconstructor import Reconstruction, Reconstructor
from nerif.reconstruction.rig_parameters import with_corrections
from nerif.reconstruction.uncertainty.deviations import VOXELS, Deviations, blurred
from nerif.reconstruction.uncertainty.rig_posterior import RigPosterior

__all__ = ["KINDS", "BootstrapDeviations", "Maps", "Member", "Original", "Trials", "best_covered"]

KINDS = {"off": 0, "fast": 2, "full": 8}  # trials
DETAIL_PX = 0.7  # in the middle of the box: standard deviation of g
LOST = 1.9  # C
MIN_DETAIL = 1e-10  # of the squares of a field: less is rounding
BLOCK = 8  # px: edge of the blocks in which residuals keep their sign

Maps = Mapping[str, Float[Tensor, "view row column c"]]  # projections, or their noise, by the name of the technique


@dataclass(frozen=True)
class Original:
    """The reconstruction that the trials repeat."""

    result: Reconstruction
    reconstructor: Reconstructor
    measurement: Measurement  # with the calibrated cameras
    project: Callable[[Field, Measurement], Maps]  # from a field to its projections into the views of a measurement
    rig: RigPosterior | None = None  # if the cameras were refined

    @cached_property
    def volume(self) -> Volume:
        """The field on VOXELS voxels along the longest edge."""
        return replace(self.result, bodies=()).volume(Grid.of_resolution(self.measurement.box, VOXELS))

    @cached_property
    def corrected(self) -> Measurement:
        """The measurement with the refined cameras."""
        return with_corrections(self.measurement, self.result.rig)

    @cached_property
    def spline(self) -> VoxelField:
        """The spline through that volume."""
        return VoxelField.through(self.volume.values.double(), self.volume.grid)

    @cached_property
    def projections(self) -> Maps:
        """The projections of the spline."""
        return self.project(self.spline, self.corrected)


@dataclass(frozen=True)
class Member:
    """A trial: a reconstructor, its data, and the field that would be reconstructed without error."""

    reconstructor: Reconstructor
    measurement: Measurement
    truth: Volume


@dataclass(frozen=True)
class Trials:
    """The trials of one of KINDS."""

    kind: str

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"expected one of {', '.join(KINDS)}, got '{self.kind}'", field="uncertainty")

    @property
    def members(self) -> int:
        return KINDS[self.kind]

    def member(self, number: int, original: Original) -> Member:
        """Return a trial: another seed, and data with residuals of random sign."""
        generator = torch.Generator().manual_seed(2_000_003 + number)
        reconstructor = original.reconstructor
        if any(f.name == "seed" for f in dataclasses.fields(reconstructor)):  # type: ignore[arg-type]
            reconstructor = replace(reconstructor, seed=getattr(reconstructor, "seed") + number)  # type: ignore[type-var]  # noqa: B009
        maps, data, there, projections = {}, original.measurement, original.corrected, original.projections
        if original.rig is not None:
            there = with_corrections(data, original.rig.draw(generator))
            projections = original.project(original.spline, there)
        for o, fitted, shifted in zip(*(m.observations for m in (data, original.corrected, there)), strict=True):
            name = o.technique.name
            residual = fitted.values - original.projections[name].to(o.values)
            shift = o.values - shifted.values  # of the images
            maps[name] = projections[name].to(o.values) + shift + residual * _signs(o.values, generator)
        sigmas = {o.technique.name: o.sigma for o in data.observations}
        return Member(reconstructor, data.observed(maps, sigmas), original.volume)


def best_covered(cameras: Sequence[Camera]) -> list[str]:
    """Return the names of the views, sorted by the angles to their two nearest neighbours; opposite views coincide.

    The first is the one whose information the others contain most of.
    """
    axes = torch.stack([camera.rotation[2].double() for camera in cameras])
    apart = torch.acos((axes @ axes.T).abs().clamp(max=1.0))
    apart.fill_diagonal_(math.inf)
    near = apart.sort(dim=1).values[:, : min(2, len(axes) - 1)].sum(dim=1) if len(axes) > 1 else torch.zeros(1)
    middle = (torch.arange(len(axes)) - (len(axes) - 1) / 2).abs()
    order = np.lexsort((middle.numpy(), near.numpy().round(6)))
    return [cameras[int(i)].name for i in order]


def _signs(like: Float[Tensor, "view row column c"], generator: torch.Generator) -> Tensor:
    """1 or -1 at random, the same in blocks of pixels."""
    views, height, width, channels = like.shape
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    coarse = torch.randint(0, 2, (views, rows, columns, channels), generator=generator) * 2 - 1
    fine = coarse.repeat_interleave(BLOCK, dim=1).repeat_interleave(BLOCK, dim=2)
    return fine[:, :height, :width].to(like)


class BootstrapDeviations(Deviations):
    """Standard deviations from the errors of trials.

    `original` is the reconstruction that they repeat.
    """

    def __init__(self, main: Volume, medium: Medium, original: Original) -> None:
        super().__init__(main, medium, original.result.bodies)
        self.original = original
        self.pixel = mean(original.measurement.pixel_sizes)  # mm, in the middle of the box
        self.detail: list[tuple[float, float]] = []  # mean square of a trial and of its truth, where that has any
        self.residual_ratios: list[float] = []  # mean square of a trial over that of the reconstruction

    def add_trial(self, member: Member, result: Reconstruction) -> None:
        """Add the error of a trial."""
        grid = member.truth.grid
        both = [v.values.double() for v in (replace(result, bodies=()).volume(grid), member.truth)]
        if self.bodies:
            both = [v.masked_fill(contained(self.bodies, grid.points()), 0.0) for v in both]
        self.add(both[0] - both[1], grid)
        fine = [float((v - blurred(v, grid, DETAIL_PX * self.pixel)).square().mean()) for v in both]
        if fine[1] > MIN_DETAIL * float(both[1].square().mean()):
            self.detail.append((fine[0], fine[1]))
        residuals = self._residuals(result, with_corrections(member.measurement, result.rig))
        self.residual_ratios += [j / q for j, q in zip(residuals, self._original_residuals, strict=True) if q > 0]

    @cached_property
    def _original_residuals(self) -> list[float]:
        return self._residuals(self.original.result, self.original.corrected)

    def _residuals(self, result: Reconstruction, measurement: Measurement) -> list[float]:
        """Mean square residual of each technique, over sigma^2 where that is known."""
        projections, squares = self.original.project(result.field, measurement), []
        for o in measurement.observations:
            used = measurement.usable_for(o) & measurement.sees_box
            residual = (o.values - projections[o.technique.name].to(o.values))[used].double()
            if o.sigma is not None:
                residual = residual / o.sigma[used].double()
            squares.append(float(residual.square().mean()))
        return squares

    @property
    def lost(self) -> float:
        """The share of the squared detail that trials have lost, 1 - k^2."""
        if not self.detail:
            return 0.0
        trials, truth = (sum(squares) for squares in zip(*self.detail, strict=True))
        return max(1 - trials / truth, 0.0)

    @property
    def better(self) -> float:
        """The rms residual of the reconstruction over that of the trials, rho."""
        ratios = self.residual_ratios
        return mean(ratios) ** -0.5 if ratios and mean(ratios) > 0 else 1.0

    @property
    def factor(self) -> float:
        return self.better * math.exp(LOST * math.sqrt(self.lost))
