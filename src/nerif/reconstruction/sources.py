"""The data to fit: images, the displacements computed from them, or both.

Images can be fitted only where the predicted displacement already leads to the right dot. A network therefore starts
with displacements if there are any, else with images blurred by several pixels, and continues with images blurred by
SOFT_PX. A sharp pattern is not determined between pixels: that much blur reduces the error of cubic splines more than
the signal (docs/decisions/028).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.measurement_data import Observation
from nerif.forward.forward_model import masked_blur
from nerif.forward.images import GUESS, Images

__all__ = ["DataStage", "check_source", "of_source", "resolve_source", "stages"]

SOURCES = ("auto", "images", "displacements", "both")
SOFT_PX = 0.6  # standard deviation
BLURS_PX = (4.0, 2.0, 1.0)  # before that, without displacements
FILL_PX = 6.0  # over which displacements are extrapolated to pixels without one
SHARP_FROM = 0.3  # of a run
FITTED_AGAIN = (0.5, 0.75)  # of a run: intensity gains and offsets are fitted again


@dataclass(frozen=True)
class DataStage:
    """A part of a run."""

    begin: float  # share of the run at which it begins
    measurement: Callable[[], Measurement]  # the data to fit
    words: str  # their name


def check_source(source: str, measurement: Measurement | None = None) -> None:
    """Raise InputError unless it is one of SOURCES, and a measurement, if given, holds these data."""
    if source not in SOURCES:
        raise InputError(f"expected one of {', '.join(SOURCES)}, got '{source}'", field="from")
    if measurement is None:
        return
    images, displacements = _pair(measurement)
    if images is None and source in ("images", "both"):
        names = " and ".join(o.technique.measured for o in measurement.observations)
        raise InputError(
            f"expected a measurement with images (variables reference and flow) for '{source}', got {names}; "
            "nerif displacement writes them",
            field="from",
        )
    if images is not None and displacements is None and source in ("displacements", "both"):
        raise InputError(f"expected displacements for '{source}', got images alone; give --from images", field="from")


def resolve_source(measurement: Measurement, source: str, preferred: str) -> str:
    """Return the source, with "auto" replaced by the preferred one if there are both displacements and images."""
    images, displacements = _pair(measurement)
    return preferred if source == "auto" and images is not None and displacements is not None else source


def of_source(measurement: Measurement, source: str, blur: float = SOFT_PX, preferred: str = "images") -> Measurement:
    """Return the measurement with the data to fit: images (blurred, standard deviation in px), displacements, or both.

    Data of other techniques are unchanged. Images retain the displacements as a first approximation.
    """
    check_source(source, measurement)
    images, displacements = _pair(measurement)
    if images is None:
        return measurement
    source = resolve_source(measurement, source, preferred)
    if displacements is not None and source == "displacements":
        return images.without(measurement)
    whole = measurement if source == "both" or displacements is None else displacements.without(measurement)
    sizes = [camera.image_size for camera in whole.cameras]
    maps = Images.blur(whole.maps, sizes, blur)
    variable = Images.measured
    maps[variable] = maps[variable].where(whole.usable_for(_pair(whole)[0] or images), math.nan)
    if displacements is not None:
        views = [measurement.names.index(name) for name in whole.names]
        maps[GUESS] = _extrapolated(measurement, displacements)[views]
    return replace(whole, maps=maps)


def stages(measurement: Measurement, source: str) -> list[DataStage]:
    """Return the stages of the training of a network."""
    images, displacements = _pair(measurement)
    final = of_source(measurement, source)

    def last() -> Measurement:
        return final

    if images is None or source == "displacements":
        return [DataStage(0.0, last, " and ".join(o.technique.measured for o in final.observations))]
    ends = [DataStage(begin, last, "images") for begin in (SHARP_FROM, *FITTED_AGAIN)]
    if displacements is not None:
        return [DataStage(0.0, partial(of_source, measurement, "displacements"), "displacements"), *ends]
    blurred = []
    for i, px in enumerate(BLURS_PX):
        data = partial(of_source, measurement, source, px)
        blurred.append(DataStage(SHARP_FROM * i / len(BLURS_PX), data, f"images blurred by {px:g} px"))
    return [*blurred, *ends]


def _pair(measurement: Measurement) -> tuple[Observation | None, Observation | None]:
    """The images and the displacements computed from them, or None."""
    by_name = {o.technique.name: o for o in measurement.observations}
    images = next((o for o in by_name.values() if o.technique.derived), None)
    return images, None if images is None else by_name.get(images.technique.derived)


def _extrapolated(measurement: Measurement, displacements: Observation) -> Float[Tensor, "view row column 2"]:
    """The displacement, and where it is not usable a weighted mean of its surroundings."""
    d, usable = displacements.values, measurement.usable_for(displacements)
    result = torch.zeros_like(d)
    for i, camera in enumerate(measurement.cameras):
        inside = i, slice(0, camera.image_size[0]), slice(0, camera.image_size[1])
        good = usable[inside]
        mean = masked_blur(d[inside], good, FILL_PX).to(d)
        result[inside] = torch.where(good[..., None], d[inside], mean)
    return result
