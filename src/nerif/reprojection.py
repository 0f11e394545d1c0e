"""A reconstruction re-projected into the views it was measured from, and the file that keeps both side by side."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.atomic import atomic
from nerif.conventions import InputError
from nerif.measurement import Measurement
from nerif.measurement_file import encoding, from_dataset, to_dataset
from nerif.netcdf import opened
from nerif.techniques.base import ForwardModel
from nerif.techniques.deflection import Deflection

__all__ = ["Accuracy", "Reprojection"]


@dataclass(frozen=True)
class Accuracy:
    """How views were predicted, and how far from the path integral through the field itself.

    Parameters
    ----------
    how : in words
    error_px : rms difference from that integral over the compared pixels, px; 0 where it is the integral
    compared : pixels on which both were computed, or 0
    """

    how: str = "the path integral through the field on every pixel"
    error_px: float = 0.0
    compared: int = 0

    @property
    def sentence(self) -> str:
        """What to tell of it."""
        if not self.compared:
            return f"re-projected by {self.how}"
        apart = f"{self.error_px:.2g} px rms from the path integral through the network on {self.compared} pixels"
        return f"re-projected by {self.how}; {apart}"


@dataclass(frozen=True)
class Reprojection:
    """What was measured, and what the reconstructed field predicts.

    Parameters
    ----------
    measurement : Measurement
    maps : (view, row, column, c) predicted, by the name of the technique; 0 where a ray misses the box
    held_out : names of the views that the reconstruction has not seen
    accuracy : of the prediction
    """

    measurement: Measurement
    maps: Mapping[str, Float[Tensor, "view row column c"]]
    held_out: tuple[str, ...] = ()
    accuracy: Accuracy = Accuracy()

    @property
    def predicted(self) -> Float[Tensor, "view row column c"]:
        """What is predicted of the first technique."""
        return self.maps[self.measurement.observations[0].technique.name]

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a measurement file of what is predicted, with `measured` and `held_out` in it, atomically."""
        import numpy as np

        measurement = self.measurement
        sigmas = {o.technique.name: o.sigma for o in measurement.observations}
        predicted = replace(measurement.observed(self.maps, sigmas), valid=measurement.usable)
        dataset = to_dataset(predicted)
        for o in measurement.observations:
            like = dataset[o.technique.measured]
            about = {"units": o.technique.unit, "long_name": f"measured {o.technique.measured}"}
            dataset[_measured(o.technique)] = (like.dims, o.values.float().numpy().reshape(like.shape), about)
        held = np.array([name in self.held_out for name in self.measurement.names], dtype=np.int8)
        about = {"units": "1", "long_name": "1 where the reconstruction has not seen it"}
        dataset["held_out"] = (("view",), held, about)
        dataset.attrs |= {"predicted_by": self.accuracy.how, "predicted_error_px": self.accuracy.error_px}
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
            for name in (*names.values(), "held_out"):
                if name not in data:
                    raise InputError(f"expected variables '{name}' and 'held_out', got a plain measurement")
            maps = {o.technique.name: o.values for o in predicted.observations}
            sigmas = {o.technique.name: o.sigma for o in predicted.observations}
            measured = {
                kind: torch.from_numpy(np.asarray(data[name].values, dtype=np.float32)).reshape(maps[kind].shape)
                for kind, name in names.items()
            }
            held_out = tuple(n for n, held in zip(predicted.names, data["held_out"].values, strict=True) if held)
        return cls(predicted.observed(measured, sigmas), maps, held_out)


def _measured(kind: type[ForwardModel]) -> str:
    """Name of the variable that holds what was measured."""
    return "measured" if kind is Deflection else f"measured_{kind.measured}"
