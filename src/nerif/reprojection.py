"""A reconstruction re-projected into the views it was measured from, and the file that keeps both side by side."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.atomic import atomic
from nerif.conventions import InputError
from nerif.measurement import Measurement
from nerif.measurement_file import VARIABLES, encoding, from_dataset, to_dataset
from nerif.netcdf import opened

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
    predicted : (view, row, column, 2) displacement, px; 0 where a ray misses the box
    held_out : names of the views that the reconstruction has not seen
    accuracy : of the prediction
    """

    measurement: Measurement
    predicted: Float[Tensor, "view row column 2"]
    held_out: tuple[str, ...] = ()
    accuracy: Accuracy = Accuracy()

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a measurement file of the predicted displacement, with `measured` and `held_out` in it, atomically."""
        import numpy as np

        predicted = replace(self.measurement, displacement=self.predicted, valid=self.measurement.usable)
        dataset = to_dataset(predicted)
        about = {"units": "px", "long_name": "measured displacement"}
        dataset["measured"] = (VARIABLES["displacement"][0], self.measurement.displacement.float().numpy(), about)
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
            if "measured" not in data or "held_out" not in data:
                raise InputError("expected variables 'measured' and 'held_out', got a plain measurement")
            predicted = Measurement(**from_dataset(data))
            measured = torch.from_numpy(np.asarray(data["measured"].values, dtype=np.float32))
            held_out = tuple(n for n, held in zip(predicted.names, data["held_out"].values, strict=True) if held)
        return cls(replace(predicted, displacement=measured), predicted.displacement, held_out)
