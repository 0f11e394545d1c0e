"""Programs that compute vectors: how their files count pixels, and which way axes point (table in docs/vectors.md).

All vectors point from the first image to the second.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from nerif.common.conventions import InputError
from nerif.imaging.vectors.vector_map import VectorMap
from nerif.imaging.vectors.vector_settings import LENGTHS, RATES, VectorSettings

__all__ = ["DANTEC", "DAVIS", "INSIGHT", "OPENPIV", "PIVLAB", "TABLE", "Program", "ProgramVectors", "length_unit"]

Column = Float[np.ndarray, " n"]
PIXELS = ("px", "pix", "pixel", "pixels", "px/frame", "pixel/frame", "px/dt")
MIDDLE = 0.5  # of the displacement: windows of both images are shifted by half of it


@dataclass(frozen=True)
class Program:
    """Conventions of the files of one program."""

    name: str
    first_pixel: float  #: coordinate of the centre of the first pixel
    lag: float | None
    """Share of the displacement from the position of a vector to that on the second image; None: it is on the flow
    image, whichever was first."""
    lowest_pixel: float | None = None  #: coordinate of the centre of the last row where y is up; None: as the first


# Sources: PIVlab +piv/piv_FFTmulti.m, +export/file_save.m, mat_file_save.m, save_session_function.m; OpenPIV tools.py,
# pyprocess.py, windef.py; DaVis lvpyio types/frame.py, plot_utils.py; the heads of the files of Insight, Dynamic Studio
PIVLAB = Program("PIVlab", 1.5, 1.0, lowest_pixel=-0.5)  # with y up, y' = height - y
OPENPIV = Program("OpenPIV", 0.5, MIDDLE)
DAVIS = Program("DaVis", 0.5, MIDDLE)
INSIGHT = Program("Insight", 0.5, MIDDLE)
DANTEC = Program("Dynamic Studio", 0.5, MIDDLE)
TABLE = Program("a table", 0.0, None)


def length_unit(text: str) -> str:
    """Return a unit of a file by its name in VectorSettings: px, mm, m/s, ...; "" if unknown."""
    unit = text.strip().lower().replace("/frame", "") or text.strip().lower()
    unit = re.sub(r"[ .*]*s(\^|\*\*)?-1$|[ .*]s⁻¹$", "/s", unit)
    if unit in PIXELS:
        return "px"
    return unit if unit in LENGTHS or unit in RATES else ""


@dataclass(frozen=True)
class ProgramVectors:
    """Vectors (n,) of one view and one instant, as their program wrote them."""

    program: Program
    x: Column
    y: Column
    u: Column
    v: Column
    valid: Bool[np.ndarray, " n"]
    position_unit: str = "px"
    vector_unit: str = "px"
    y_up: bool = False
    mirrored: bool = False  #: whether y up mirrors the rows of the grid, not those of the image
    scale: float = 0.0  #: mm of a pixel; 0 if unknown
    time_step: float = 0.0  #: s between the images; 0 if unknown
    origin: tuple[float, float] | None = None  #: pixel of x = y = 0 of positions in units of length
    sigma: Float[np.ndarray, "n 2"] | None = None  #: standard deviation in the unit of the vectors
    window: float = 0.0  #: px; 0 if unknown
    replaced: str = ""  #: what the file says and the user states otherwise

    @classmethod
    def of_maps(
        cls, program: Program, maps: Sequence[Shaped[np.ndarray, "row column"]], **properties: Any
    ) -> ProgramVectors:  # fmt: skip
        """Return the vectors of maps x, y, u, v, valid."""
        x, y, u, v, valid = (a.ravel() for a in maps)
        kind = np.float64
        return cls(program, x.astype(kind), y.astype(kind), u.astype(kind), v.astype(kind), valid, **properties)

    def stated(self, settings: VectorSettings) -> ProgramVectors:
        """Return the vectors with what the user states instead of the file."""
        changes = {
            "position_unit": settings.position_unit, "vector_unit": settings.vector_unit, "scale": settings.scale,
            "time_step": settings.time_step, "origin": settings.origin, "window": settings.window,
        }  # fmt: skip
        stated = replace(self, **{name: value for name, value in changes.items() if value})
        units = {stated.position_unit, stated.vector_unit}
        needless = {
            "scale": settings.scale and units == {"px"}, "time_step": settings.time_step and not units & {*RATES},
            "origin": settings.origin is not None and stated.position_unit == "px",
        }  # fmt: skip
        for name, refused in needless.items():
            if refused:
                what = f"positions in {stated.position_unit} and vectors in {stated.vector_unit}"
                raise InputError(
                    f"expected none for {what}; omit it, or give --position-unit and --vector-unit", field=name
                )
        up = settings.y_axis == "up" if settings.y_axis else self.y_up
        numbers = {name: getattr(self, name) for name in ("scale", "time_step")}
        others = [f"{name} {value:.5g}" for name, value in numbers.items() if value and value != getattr(stated, name)]
        return replace(stated, y_up=up, replaced=" and ".join(others).replace("_", " "))

    @property
    def words(self) -> str:
        """The conventions in one line."""
        lengths = {self.position_unit, self.vector_unit} != {"px"}
        scale = f", {self.scale:.5g} mm a pixel" if self.scale and lengths else ""
        step = f", {self.time_step:g} s between the images" if self.time_step and self.vector_unit in RATES else ""
        return (
            f"vectors of {self.program.name}: x and y in {self.position_unit}, u and v in {self.vector_unit}"
            f"{scale}{step}{f' (in the file {self.replaced})' if self.replaced else ''}, "
            f"y and v {'up' if self.y_up else 'down'}, the first pixel at {self.program.first_pixel:g}"
        )

    def map(self, height: int | None, place: object, flow_first: bool = False) -> VectorMap:
        """Return the displacements with flow, in pixels of the images, u right and v down.

        Parameters
        ----------
        height : of the images, px; needed where y is counted from below
        flow_first : whether the vectors point from the image with flow to the one without
        """
        scale = self._mm_per_unit_and_pixel(place)
        first = np.full(2, self.program.first_pixel)
        if self.y_up and self.program.lowest_pixel is not None:
            first[1] = self.program.lowest_pixel
        position = np.stack([self.x, self.y], axis=-1).astype(np.float64)
        if self.position_unit != "px":
            position *= LENGTHS[self.position_unit] / scale
        if self.origin is not None and self.position_unit != "px":
            position = np.array(self.origin) + position * (1, -1 if self.y_up else 1)
        elif self.y_up and self.mirrored:
            position[:, 1] = position[:, 1].min() + position[:, 1].max() - position[:, 1]
            position -= first
        else:
            position -= first
            if self.y_up:
                position[:, 1] = self._height(height, place) - 1 - position[:, 1]
        factor = 1.0
        if self.vector_unit != "px":
            rate = self.vector_unit in RATES
            if rate and not self.time_step:
                raise InputError(
                    f"expected the time between the images of vectors in {self.vector_unit}; give --time-step SECONDS "
                    "(1 if the program took it as 1)",
                    field=place,
                )
            factor = (RATES[self.vector_unit] * self.time_step if rate else LENGTHS[self.vector_unit]) / scale
        lag = self.program.lag
        if flow_first:
            factor, lag = -factor, None if lag is None else 1 - lag
        v = -self.v if self.y_up else self.v
        sigma = None if self.sigma is None else self.sigma * abs(factor)
        x, y = position.T
        return VectorMap.of_points(x, y, self.u * factor, v * factor, self.valid, place, sigma, self.window, lag or 0.0)

    @staticmethod
    def _height(height: int | None, place: object) -> int:
        if height is None:
            raise InputError(
                "expected the height of the images, since y is counted from below; its camera has no image size: "
                "import it with nerif calibrate FILE --image-size HEIGHT WIDTH",
                field=place,
            )
        return height

    def _mm_per_unit_and_pixel(self, place: object) -> float:
        """Return the length of a pixel, mm, which vectors in units of length need."""
        if self.scale or (self.position_unit == "px" and self.vector_unit == "px"):
            return self.scale or 1.0
        units = " and ".join(
            f"{what} in {unit}"
            for what, unit in (("positions", self.position_unit), ("vectors", self.vector_unit))
            if unit != "px"
        )
        raise InputError(
            f"expected vectors in px, got {units} without the length of a pixel; give --scale MM, or export them in px",
            field=place,
        )
