"""How sure a reconstruction is: the same again with other seeds and other noise, and the spread of what comes out.

    mean = sum_k q_k / K,      std^2 = sum_k (q_k - mean)^2 / (K - 1)

Each member sees what was measured with noise of its sigma added once more, and starts from another seed. The spread
tells what noise and chance do. It does not tell what all members have in common: what the views do not see, and what
the method smooths away.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import InputError
from nerif.measurement import Measurement
from nerif.reconstruction.base import Reconstructor
from nerif.volume import Volume, describe

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

    def left_out(self, number: int, measurement: Measurement) -> tuple[str, ...]:
        """Names of the views that member `number` (from 1) does without."""
        names = measurement.names
        if not self.leave_one_out or len(names) < 2:
            return ()
        return (names[(number - 1) % len(names)],)

    def member(
        self,
        number: int,
        reconstructor: Reconstructor,
        measurement: Measurement,
        noise: Mapping[str, Float[Tensor, "view row column c"]],
    ) -> tuple[Reconstructor, Measurement]:
        """Return what member `number` is reconstructed by and from.

        Parameters
        ----------
        number : 1 to members
        reconstructor : settings of the run; its seed, if it has one, is moved on
        measurement : what was measured
        noise : standard deviation of the noise to add, by the name of the technique
        """
        seed = getattr(reconstructor, "seed", 0)
        generator = torch.Generator().manual_seed(1_000_003 * (seed + 1) + number)
        noisy, sigmas = {}, {}
        for o in measurement.observations:
            name = o.technique.name
            noisy[name] = o.values + noise[name] * torch.randn(o.values.shape, generator=generator)
            # the noise is there twice now, and independent: variances add
            sigmas[name] = None if o.sigma is None else o.sigma * math.sqrt(2)
        member = measurement.observed(noisy, sigmas)
        out = self.left_out(number, measurement)
        if out:
            member = member.select([name for name in member.names if name not in out])
        if any(f.name == "seed" for f in dataclasses.fields(reconstructor)):  # type: ignore[arg-type]
            reconstructor = replace(reconstructor, seed=seed + number)  # type: ignore[type-var]
        return reconstructor, member


@dataclass
class Spread:
    """Running mean and standard deviation of volumes by quantity (Welford's update); NaN where any member is masked."""

    count: int = 0
    first: dict[str, Volume] = field(default_factory=dict)
    mean: dict[str, Tensor] = field(default_factory=dict)
    squares: dict[str, Tensor] = field(default_factory=dict)

    def add(self, volumes: list[Volume]) -> None:
        """Take in the quantities of one more member."""
        self.count += 1
        for v in volumes:
            values = v.values.double()
            if v.quantity not in self.first:
                self.first[v.quantity] = v
                self.mean[v.quantity], self.squares[v.quantity] = torch.zeros_like(values), torch.zeros_like(values)
            change = values - self.mean[v.quantity]
            self.mean[v.quantity] += change / self.count
            self.squares[v.quantity] += change * (values - self.mean[v.quantity])

    def volumes(self) -> list[Volume]:
        """Return mean and standard deviation of every quantity, as density_mean, density_std and so on."""
        found = []
        for quantity, first in self.first.items():
            std = (self.squares[quantity] / max(self.count - 1, 1)).sqrt()
            for name, values in (("mean", self.mean[quantity]), ("std", std)):
                label = f"{quantity}_{name}"
                notes: dict[str, float | str] = {"members": self.count}
                if "assumption" in first.notes:
                    notes |= {
                        "assumption": first.notes["assumption"],
                        "masked_voxels": int(torch.isnan(values).sum()),
                        "masked_where": f"{first.notes['masked_where']}, in any member",
                    }
                kept = values if label == "n_mean" else values.float()
                found.append(Volume(kept, first.grid, label, describe(label)[0], first.attributes, notes))
        return found
