"""Re-projection of a reconstruction into its views, and the file with prediction and measurement."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError, with_unit
from nerif.common.netcdf import opened, write_dataset
from nerif.data.measurement import Measurement
from nerif.data.measurement_file import encoding, from_dataset, to_dataset
from nerif.forward.forward_model import ForwardModel
from nerif.forward.registry import ASSUMED

__all__ = ["Accuracy", "Reprojection"]


@dataclass(frozen=True)
class Accuracy:
    """Method and accuracy of a prediction."""

    technique: type[ForwardModel]  #: quantity that a pixel measures
    method: str = "the path integral through the field on every pixel"  #: in words
    error: float = 0.0
    """Rms difference from the path integral through the field over some pixels, in the technique's unit."""
    pixels: int = 0  #: number compared; 0 if the prediction is that integral

    @property
    def sentence(self) -> str:
        """Report of method and error."""
        method = f"{self.technique.measured} re-projected by {self.method}"
        if not self.pixels:
            return method
        error = f"{with_unit(f'{self.error:.2g}', self.technique.unit)} rms"
        return f"{method}; {error} from the path integral through the network on {self.pixels} pixels"

    @property
    def entries(self) -> dict[str, Any]:
        """Entries of metrics.json."""
        kind = self.technique
        summary = {"measured": kind.measured, "unit": kind.unit, "method": self.method}
        return {**summary, "error": self.error, "pixels": self.pixels}


@dataclass(frozen=True)
class Reprojection:
    """A measurement, and its prediction from the reconstructed field."""

    measurement: Measurement
    maps: Mapping[str, Float[Tensor, "view row column c"]]
    """(view, row, column, c) predicted values, by the name of the technique; 0 where a ray misses the box, NaN where
    a pixel sees a body."""
    withheld: tuple[str, ...] = ()  #: names of the views withheld from the reconstruction
    accuracies: tuple[Accuracy, ...] = ()  #: of the prediction by technique; empty if unknown (from a file)

    @property
    def predicted(self) -> Float[Tensor, "view row column c"]:
        """Predicted values of the first technique."""
        return self.maps[self.measurement.observations[0].technique.name]

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a measurement file of the predicted values, with variables `measured` and `withheld`, atomically."""
        import numpy as np

        measurement = self.measurement
        sigmas = {o.technique.name: o.sigma for o in measurement.observations}
        predicted = replace(measurement.observed(self.maps, sigmas), valid=measurement.usable)
        dataset = to_dataset(predicted)
        for o in measurement.observations:
            like = dataset[o.technique.measured]
            attributes = {"units": o.technique.unit, "long_name": f"measured {o.technique.measured}"}
            dataset[_variable(o.technique)] = (like.dims, o.values.float().numpy().reshape(like.shape), attributes)
        withheld = np.array([name in self.withheld for name in self.measurement.names], dtype=np.int8)
        attributes = {"units": "1", "long_name": "1: withheld from the reconstruction"}
        dataset["withheld"] = (("view",), withheld, attributes)
        for accuracy in self.accuracies:
            dataset.attrs["predicted_by"] = accuracy.method
            if accuracy.technique.measured in dataset:  # displacements of a measurement of images only
                dataset[accuracy.technique.measured].attrs["predicted_error"] = accuracy.error
        write_dataset(path, dataset, encoding(dataset))

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Reprojection:
        """Read the file."""
        import numpy as np

        with opened(path, "a re-projection") as data:
            predicted = Measurement(**from_dataset(data))
            names = {o.technique.name: _variable(o.technique) for o in predicted.observations}
            for name in (*names.values(), "withheld"):
                if name not in data:
                    raise InputError(f"expected variables '{name}' and 'withheld', got a plain measurement")
            maps = {o.technique.name: o.values for o in predicted.observations}
            sigmas = {o.technique.name: o.sigma for o in predicted.observations}
            values = {
                kind: torch.from_numpy(np.asarray(data[name].values, dtype=np.float32)).reshape(maps[kind].shape)
                for kind, name in names.items()
            }
            withheld = tuple(n for n, flag in zip(predicted.names, data["withheld"].values, strict=True) if flag)
        return cls(predicted.observed(values, sigmas), maps, withheld)


def _variable(kind: type[ForwardModel]) -> str:
    """Return the name of the variable of measured values."""
    return "measured" if kind is ASSUMED else f"measured_{kind.measured}"
