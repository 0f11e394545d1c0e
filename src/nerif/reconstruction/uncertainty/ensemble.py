"""How sure a reconstruction is: the same again with other seeds and other noise, and the spread of what comes out.

    mean = sum_k q_k / K,      std^2 = sum_k (q_k - mean)^2 / (K - 1)

Each member sees what was measured with noise of its sigma added once more, and starts from another seed. The spread
tells what noise and chance do. It does not tell what all members have in common: what the views do not see, and what
the method smooths away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume, describe
from nerif.geometry import Grid
from nerif.physics.quantities import LINEAR, GasSettings, derive, derive_all, deviation
from nerif.reconstruction.base import Reconstruction
from nerif.reconstruction.uncertainty.repetition import Found, Member, other_seed

__all__ = ["Ensemble", "Spread"]


@dataclass(frozen=True)
class Ensemble:
    """Members of an ensemble.

    Parameters
    ----------
    members : how many, 2 or more
    leave_one_out : member k also does without view k, in turn
    """

    members: int
    leave_one_out: bool = False

    def __post_init__(self) -> None:
        if self.members < 2:
            raise InputError(f"ensemble: expected 2 members or more (0 for none), got {self.members}")

    @property
    def word(self) -> str:
        return "ensemble"

    @property
    def fewest(self) -> int:
        return 2

    @property
    def without_views(self) -> bool:
        return self.leave_one_out

    def left_out(self, number: int, measurement: Measurement) -> tuple[str, ...]:
        """Names of the views that member `number` (from 1) does without."""
        names = measurement.names
        if not self.leave_one_out or len(names) < 2:
            return ()
        return (names[(number - 1) % len(names)],)

    def member(self, number: int, found: Found) -> Member:
        """Return member `number`, from 1 on: noise of the measurement's size is added once more."""
        measurement, noise = found.measurement, found.noise()
        seed = getattr(found.reconstructor, "seed", 0)
        generator = torch.Generator().manual_seed(1_000_003 * (seed + 1) + number)
        noisy, sigmas = {}, {}
        for o in measurement.observations:
            name = o.technique.name
            noisy[name] = o.values + noise[name] * torch.randn(o.values.shape, generator=generator)
            # the noise is there twice now, and independent: variances add
            sigmas[name] = None if o.sigma is None else o.sigma * math.sqrt(2)
        member, out = measurement.observed(noisy, sigmas), self.left_out(number, measurement)
        if out:
            member = member.select([name for name in member.names if name not in out])
        about = "".join(f", without {name}" for name in out)
        return Member(other_seed(found.reconstructor, number), member, out, about=about)

    def taken(self, found: Found, main: Volume, gas: GasSettings) -> Spread:
        return Spread(main.grid, gas)


@dataclass
class Spread:
    """Running mean and standard deviation of the field and of its temperature (Welford's update).

    n and density are linear functions of the field: theirs follow. Temperature is NaN where any member is masked.

    Parameters
    ----------
    grid : on which members are sampled
    gas : what density and temperature are computed for
    """

    grid: Grid
    gas: GasSettings
    count: int = 0
    first: dict[str, Volume] = field(default_factory=dict)
    mean: dict[str, Tensor] = field(default_factory=dict)
    squares: dict[str, Tensor] = field(default_factory=dict)

    def add(self, member: Member, result: Reconstruction) -> None:
        """Take in the quantities of one more member."""
        self.count += 1
        for v in derive_all(result.volume(self.grid), self.gas):
            new = self.first.setdefault(v.quantity, v) is v
            if v.quantity in LINEAR:
                continue
            values = v.values.double()
            if new:
                self.mean[v.quantity], self.squares[v.quantity] = torch.zeros_like(values), torch.zeros_like(values)
            change = values - self.mean[v.quantity]
            self.mean[v.quantity] += change / self.count
            self.squares[v.quantity] += change * (values - self.mean[v.quantity])

    def volumes(self) -> list[Volume]:
        """Return mean and standard deviation of every quantity, as density_mean, density_std and so on."""
        found = []
        stds = {quantity: (squares / max(self.count - 1, 1)).sqrt() for quantity, squares in self.squares.items()}
        one = next(iter(self.first.values()))  # the field of a member
        average = replace(one, values=self.mean[one.quantity])
        for quantity, first in self.first.items():
            if quantity in LINEAR:
                mean = derive(average, quantity, self.gas).values
                std, where = deviation(average, stds[one.quantity], quantity, self.gas), "in the mean"
            else:
                mean, std, where = self.mean[quantity], stds[quantity], "in any member"
            for name, values in (("mean", mean), ("std", std)):
                label = f"{quantity}_{name}"
                notes: dict[str, float | str] = {"members": self.count}
                if "assumption" in first.notes:
                    notes |= {
                        "assumption": first.notes["assumption"],
                        "masked_voxels": int(torch.isnan(values).sum()),
                        "masked_where": f"{first.notes['masked_where']}, {where}",
                    }
                kept = values if label == "n_mean" else values.float()
                found.append(Volume(kept, first.grid, label, describe(label)[0], first.attributes, notes))
        return found
