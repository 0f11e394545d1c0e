"""Bootstrap estimate of the error of a reconstruction, from trials on a known field: the reconstruction itself.

    std(x) = rho exp(C sqrt(1 - k^2)) (G * mean_j (q'_j - q)^2)^(1/2) (x)
    k^2 = <(q'_j - g * q'_j)^2> / <(q - g * q)^2>,    rho^2 = <(d - F q)^2> / <(d_j - F q'_j)^2>

Trial q'_j is reconstructed from simulated projections of the field q in the same cameras, to which the residuals of the
reconstruction are added in blocks of random sign: noise of the right size and spatial correlation. The error of q'_j is
then a sample of the error of q.

q is smoother than the truth, and detail that the reconstruction cannot resolve is absent from q. The loss is estimated
from the share k^2 of the detail of q that the trials retain, with g as fine as the pixels. If they retain all of it,
the errors are due to noise; if not, q has lost more of the truth than the trials have lost of q. C was fitted to
random flows (docs/decisions/055). If the reconstruction was trained longer than the trials, it fits its data d
better than they fit theirs, d_j, and its errors are smaller by rho.

A single error is noisy, so squares are averaged around each voxel by a Gaussian G. No truth is used.
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
from nerif.data.volume import Volume, describe
from nerif.fields.base import Field
from nerif.fields.grid import VoxelField
from nerif.geometry import Camera, Grid
from nerif.physics.quantities import GasSettings, derive, deviation
from nerif.reconstruction.base import Reconstruction, Reconstructor

__all__ = ["KINDS", "VOXELS", "Deviations", "Maps", "Member", "Original", "Trials", "best_covered", "certainty"]

KINDS = {"off": 0, "fast": 2, "full": 8}  # trials
VOXELS = 64  # along the longest edge of the box, on which errors are compared
WIDTH = 0.04  # of the box edge: standard deviation of G
DETAIL_PX = 0.7  # in the middle of the box: standard deviation of g
LOST = 1.9  # C
MIN_DETAIL = 1e-10  # of the squares of a field: less is rounding
BLOCK = 8  # px: edge of the blocks in which residuals keep their sign
TAILS = {"p05": -1.645, "p95": 1.645}  # standard deviations of the percentiles

Maps = Mapping[str, Float[Tensor, "view row column c"]]  # projections, or their noise, by the name of the technique


@dataclass(frozen=True)
class Original:
    """The reconstruction that the trials repeat."""

    result: Reconstruction
    reconstructor: Reconstructor
    measurement: Measurement
    project: Callable[[Field], Maps]  # from a field to its projections into the views of the measurement

    @cached_property
    def volume(self) -> Volume:
        """The field on VOXELS voxels along the longest edge."""
        return self.result.volume(Grid.of_resolution(self.result.box, VOXELS))

    @cached_property
    def projections(self) -> Maps:
        """The projections of a spline through that volume."""
        return self.project(VoxelField.through(self.volume.values.double(), self.volume.grid))


@dataclass(frozen=True)
class Member:
    """A trial: a reconstructor, its data, and the field that would be reconstructed without error."""

    reconstructor: Reconstructor
    measurement: Measurement
    truth: Volume


def certainty(field: Volume, std: Volume) -> Volume:
    """Return q^2 / (q^2 + std^2), between 0 and 1; 0 where both are 0.

    As the opacity of a volume it hides the ambient and fades what is uncertain.

    Source: the gain of Wiener's filter, Extrapolation, Interpolation, and Smoothing of Stationary Time Series (1949).
    """
    signal, noise = field.values.double().square(), std.values.double().square()
    values = torch.where(signal + noise > 0, signal / (signal + noise), 0.0).nan_to_num(0.0)
    label = f"{field.quantity}_certainty"
    return Volume(values.float(), field.grid, label, *describe(label)[:1], field.attributes)


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
        maps, data = {}, original.measurement
        for o in data.observations:
            projections = original.projections[o.technique.name].to(o.values)
            maps[o.technique.name] = projections + (o.values - projections) * _signs(o.values, generator)
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


def _residuals(measurement: Measurement, projections: Maps) -> list[float]:
    """Mean square residual of each technique, over sigma^2 where that is known."""
    squares = []
    for o in measurement.observations:
        used = measurement.usable_for(o) & measurement.sees_box
        residual = (o.values - projections[o.technique.name].to(o.values))[used].double()
        if o.sigma is not None:
            residual = residual / o.sigma[used].double()
        squares.append(float(residual.square().mean()))
    return squares


def _blurred(values: Tensor, grid: Grid, mm: float) -> Tensor:
    """The mean over a Gaussian with a standard deviation in mm, at least a voxel."""
    from scipy.ndimage import gaussian_filter

    width = [max(1.0, mm / h) for h in grid.spacing[::-1]]  # voxels along z, y, x
    return torch.from_numpy(gaussian_filter(values.double().numpy(), width, mode="nearest"))


class Deviations:
    """Standard deviations of every quantity from the errors of trials.

    `main` is the original field on the grid of the result.
    """

    def __init__(self, main: Volume, gas: GasSettings, original: Original) -> None:
        self.main, self.gas, self.original = main, gas, original
        self.pixel = mean(original.measurement.pixel_sizes)  # mm, in the middle of the box
        self.squares: list[Tensor] = []
        self.detail: list[tuple[float, float]] = []  # mean square of a trial and of its truth, where that has any
        self.residual_ratios: list[float] = []  # mean square of a trial over that of the reconstruction
        self.grid: Grid | None = None

    @property
    def count(self) -> int:
        return len(self.squares)

    def add(self, member: Member, result: Reconstruction) -> None:
        """Add the error of a trial."""
        self.grid = member.truth.grid
        both = result.volume(self.grid).values.double(), member.truth.values.double()
        self.squares.append((both[0] - both[1]).square())
        fine = [float((v - _blurred(v, self.grid, DETAIL_PX * self.pixel)).square().mean()) for v in both]
        if fine[1] > MIN_DETAIL * float(both[1].square().mean()):
            self.detail.append((fine[0], fine[1]))
        residuals = _residuals(member.measurement, self.original.project(result.field))
        self.residual_ratios += [j / q for j, q in zip(residuals, self._original_residuals, strict=True) if q > 0]

    @cached_property
    def _original_residuals(self) -> list[float]:
        return _residuals(self.original.measurement, self.original.project(self.original.result.field))

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

    def local(self) -> Float[Tensor, "z y x"]:
        """Return the rms error of the trials around each voxel of `grid`."""
        assert self.grid is not None
        edge = math.prod(self.grid.box.edges) ** (1 / 3)
        return _blurred(torch.stack(self.squares).mean(dim=0), self.grid, WIDTH * edge).sqrt()

    def std(self) -> Volume:
        """Return the standard deviation of the field."""
        assert self.grid is not None
        values = self.better * math.exp(LOST * math.sqrt(self.lost)) * self.local()
        values = VoxelField.through(values, self.grid).sample(self.main.grid).clamp(min=0)
        return Volume(values, self.main.grid, f"{self.main.quantity}_std")

    def volumes(self) -> list[Volume]:
        """Return the standard deviation of every quantity, such as density_std; percentiles of the temperature T.

        The percentiles of the field x are x + z std; those of T, which is not linear in x, are T(x + z std).
        """
        std = self.std().values.double()
        volumes = []
        for quantity in self.gas.quantities_of(self.main):
            volumes.append(self._statistic(quantity, "std", deviation(self.main, std, quantity, self.gas)))
            if quantity == "temperature":
                for name, z in TAILS.items():
                    values = self.main.values.double() - z * std  # temperature falls as the index rises
                    n_ambient = float(self.main.attributes.get("n_ambient", 1.0))
                    tail = Volume.of(values, self.main.grid, self.main.quantity, n_ambient)
                    volumes.append(self._statistic(quantity, name, derive(tail, quantity, self.gas).values.double()))
        return volumes

    def _statistic(self, quantity: str, statistic: str, values: Tensor) -> Volume:
        label = f"{quantity}_{statistic}"
        derived = derive(self.main, quantity, self.gas)
        notes: dict[str, float | str] = {"trials": self.count}
        if "assumption" in derived.notes:
            masked = {"masked_voxels": int(torch.isnan(values).sum()), "masked_where": derived.notes["masked_where"]}
            notes |= {"assumption": derived.notes["assumption"], **masked}
        return Volume(values.float(), self.main.grid, label, describe(label)[0], derived.attributes, notes)
