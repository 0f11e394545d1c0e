"""What a reconstruction goes by, where a measurement holds displacements and the images they were found in.

Images are met only where the pattern is already at the right dot. So a network begins with the displacements, where
there are some, else with images blurred by several pixels, and goes on with images that are SOFT. Between pixels a
sharp pattern is not known: that much blur takes more from what cubic splines get wrong than from the pattern
(docs/decisions/028).
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
from nerif.data.measurement import Measurement, Observation

__all__ = ["SOURCES", "Stage", "check_source", "chosen_source", "of_source", "stages"]

SOURCES = ("auto", "images", "displacements", "both")

SOFT = 0.6  # px, standard deviation
BLURS = (4.0, 2.0, 1.0)  # px
FILLED = 6.0  # px, over which a displacement goes on where it was not measured
SHARP_FROM = 0.3  # of a run
SETTLED = (0.5, 0.75)  # of a run: what is open beside the field is fitted again


@dataclass(frozen=True)
class Stage:
    """A part of a run.

    Parameters
    ----------
    begin : share of the run at which it begins
    measurement : gives what is to be met
    words : what that is
    """

    begin: float
    measurement: Callable[[], Measurement]
    words: str


def check_source(source: str, measurement: Measurement | None = None) -> None:
    """Raise InputError unless it is one of SOURCES, and a measurement that is given holds the images asked for, or
    displacements beside its images where those are.
    """
    if source not in SOURCES:
        raise InputError(f"expected one of {', '.join(SOURCES)}, got '{source}'", field="from")
    if measurement is None:
        return
    images, found = _pair(measurement)
    if images is None and source in ("images", "both"):
        names = " and ".join(o.technique.measured for o in measurement.observations)
        raise InputError(
            f"expected a measurement with images (variables reference and flow) for '{source}', got {names}; "
            "nerif displacement writes them",
            field="from",
        )
    if images is not None and found is None and source in ("displacements", "both"):
        raise InputError(f"expected displacements for '{source}', got images alone; give --from images", field="from")


def chosen_source(measurement: Measurement, source: str, preferred: str) -> str:
    """Return what "auto" means where a measurement holds both displacements and images; any other source as it is."""
    images, found = _pair(measurement)
    return preferred if source == "auto" and images is not None and found is not None else source


def of_source(measurement: Measurement, source: str, blur: float = SOFT, preferred: str = "images") -> Measurement:
    """Return the measurement with what a reconstruction is to go by: images, displacements, or both.

    What is measured by other techniques is left as it is. Images keep what displacements tell, as a guess.

    Parameters
    ----------
    source : one of SOURCES
    blur : of the images, standard deviation in px
    preferred : what "auto" takes where there are both

    Raises
    ------
    InputError
        If the measurement does not hold what is asked for.
    """
    check_source(source, measurement)
    images, found = _pair(measurement)
    if images is None:
        return measurement
    source = chosen_source(measurement, source, preferred)
    if found is not None and source == "displacements":
        return images.without(measurement)
    whole = measurement if source == "both" or found is None else found.without(measurement)
    sizes = [camera.image_size for camera in whole.cameras]
    maps = images.technique.softened(whole.maps, sizes, blur)
    measured = images.technique.measured
    maps[measured] = maps[measured].where(whole.usable_for(_pair(whole)[0] or images), math.nan)
    if found is not None:
        known = [measurement.names.index(name) for name in whole.names]
        maps[images.technique.guess] = _filled(measurement, found)[known]
    return replace(whole, maps=maps)


def stages(measurement: Measurement, source: str) -> list[Stage]:
    """Return the parts of a network's run on a measurement (see the head of this file)."""
    images, found = _pair(measurement)
    final = of_source(measurement, source)

    def last() -> Measurement:
        return final

    if images is None or source == "displacements":
        names = " and ".join(o.technique.measured for o in final.observations)
        return [Stage(0.0, last, names)]
    ends = [Stage(begin, last, "images") for begin in (SHARP_FROM, *SETTLED)]
    if found is not None:
        return [Stage(0.0, partial(of_source, measurement, "displacements"), "displacements"), *ends]
    begins = [SHARP_FROM * i / len(BLURS) for i in range(len(BLURS))]
    blurred = [
        Stage(begin, partial(of_source, measurement, source, px), f"images blurred by {px:g} px")
        for begin, px in zip(begins, BLURS, strict=True)
    ]
    return [*blurred, *ends]


def _pair(measurement: Measurement) -> tuple[Observation | None, Observation | None]:
    """The images, and the displacements that were found in them, as far as there are any."""
    by_name = {o.technique.name: o for o in measurement.observations}
    images = next((o for o in by_name.values() if o.technique.derived), None)
    return images, None if images is None else by_name.get(images.technique.derived)


def _filled(measurement: Measurement, found: Observation) -> Float[Tensor, "view row column 2"]:
    """The displacement, and where it was not measured the mean of what is around."""
    from scipy.ndimage import gaussian_filter

    d, usable = found.values, measurement.usable_for(found)
    whole = torch.zeros_like(d)
    for i, camera in enumerate(measurement.cameras):
        inside = i, slice(0, camera.image_size[0]), slice(0, camera.image_size[1])
        good = usable[inside][..., None]
        known = torch.where(good, d[inside], 0.0).double()
        weight = torch.from_numpy(gaussian_filter(good[..., 0].double().numpy(), FILLED)).clamp(min=1e-6)
        mean = torch.from_numpy(gaussian_filter(known.numpy(), (FILLED, FILLED, 0))) / weight[..., None]
        whole[inside] = torch.where(good, d[inside], mean.to(d))
    return whole
