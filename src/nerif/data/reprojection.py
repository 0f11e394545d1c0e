"""A reconstruction re-projected into the views it was measured from, and the file that keeps both side by side."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError, with_unit
from nerif.common.files import atomic
from nerif.common.netcdf import opened
from nerif.data.measurement import Measurement
from nerif.data.measurement_file import encoding, from_dataset, to_dataset
from nerif.forward.base import ForwardModel
from nerif.forward.registry import ASSUMED

__all__ = ["Accuracy", "Reprojection"]


@dataclass(frozen=True)
class Accuracy:
    """How views were predicted, and how far from the path integral through the field itself.

    Parameters
    ----------
    technique : what a pixel measures
    how : in words
    error : rms difference from that integral over the compared pixels, in the technique's unit; 0 where it is that
        integral
    compared : pixels on which both were computed, or 0
    """

    technique: type[ForwardModel]
    how: str = "the path integral through the field on every pixel"
    error: float = 0.0
    compared: int = 0

    @property
    def sentence(self) -> str:
        """What to tell of it."""
        done = f"{self.technique.measured} re-projected by {self.how}"
        if not self.compared:
            return done
        apart = f"{with_unit(f'{self.error:.2g}', self.technique.unit)} rms"
        return f"{done}; {apart} from the path integral through the network on {self.compared} pixels"

    @property
    def entries(self) -> dict[str, Any]:
        """What metrics.json keeps of it; the error is also called error_px where that is its unit."""
        kind = self.technique
        found = {"measured": kind.measured, "unit": kind.unit, "how": self.how, "error": self.error}
        return found | ({"error_px": self.error} if kind.in_pixels() else {}) | {"compared": self.compared}


@dataclass(frozen=True)
class Reprojection:
    """What was measured, and what the reconstructed field predicts.

    Parameters
    ----------
    measurement : Measurement
    maps : (view, row, column, c) predicted, by the name of the technique; 0 where a ray misses the box
    withheld : names of the views that the reconstruction has not seen
    accuracies : of what is predicted, of each technique; none where that is not known, as of a file
    """

    measurement: Measurement
    maps: Mapping[str, Float[Tensor, "view row column c"]]
    withheld: tuple[str, ...] = ()
    accuracies: tuple[Accuracy, ...] = ()

    @property
    def predicted(self) -> Float[Tensor, "view row column c"]:
        """What is predicted of the first technique."""
        return self.maps[self.measurement.observations[0].technique.name]

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a measurement file of what is predicted, with `measured` and `withheld` in it, atomically."""
        import numpy as np

        measurement = self.measurement
        sigmas = {o.technique.name: o.sigma for o in measurement.observations}
        predicted = replace(measurement.observed(self.maps, sigmas), valid=measurement.usable)
        dataset = to_dataset(predicted)
        for o in measurement.observations:
            like = dataset[o.technique.measured]
            about = {"units": o.technique.unit, "long_name": f"measured {o.technique.measured}"}
            dataset[_measured(o.technique)] = (like.dims, o.values.float().numpy().reshape(like.shape), about)
        held = np.array([name in self.withheld for name in self.measurement.names], dtype=np.int8)
        about = {"units": "1", "long_name": "1 where the reconstruction has not seen it"}
        dataset["withheld"] = (("view",), held, about)
        for accuracy in self.accuracies:
            dataset.attrs["predicted_by"] = accuracy.how
            if accuracy.technique.measured in dataset:  # a displacement may have been seen in images alone
                dataset[accuracy.technique.measured].attrs["predicted_error"] = accuracy.error
            if accuracy.technique.in_pixels():
                dataset.attrs["predicted_error_px"] = accuracy.error
        with atomic(path) as part:
            dataset.to_netcdf(part, engine="h5netcdf", encoding=encoding(dataset))

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Reprojection:
        """Read the file.

        Raises
        ------
        InputError
            If it is missing, damaged, or holds no measured displacement.
        """
        import numpy as np

        with opened(path, "a re-projection") as data:
            predicted = Measurement(**from_dataset(data))
            names = {o.technique.name: _measured(o.technique) for o in predicted.observations}
            for name in (*names.values(), "withheld"):
                if name not in data:
                    raise InputError(f"expected variables '{name}' and 'withheld', got a plain measurement")
            maps = {o.technique.name: o.values for o in predicted.observations}
            sigmas = {o.technique.name: o.sigma for o in predicted.observations}
            measured = {
                kind: torch.from_numpy(np.asarray(data[name].values, dtype=np.float32)).reshape(maps[kind].shape)
                for kind, name in names.items()
            }
            withheld = tuple(n for n, held in zip(predicted.names, data["withheld"].values, strict=True) if held)
        return cls(predicted.observed(measured, sigmas), maps, withheld)


def _measured(kind: type[ForwardModel]) -> str:
    """Name of the variable that holds what was measured."""
    return "measured" if kind is ASSUMED else f"measured_{kind.measured}"
