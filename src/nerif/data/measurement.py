"""A measurement: cameras, and the maps that they recorded by one or several techniques."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import DEFAULT_AMBIENT_FACES, InputError, ambient_index, parse_faces, unit_shown
from nerif.common.files import atomic
from nerif.common.netcdf import opened
from nerif.forward.base import ForwardModel
from nerif.forward.registry import TECHNIQUES, forward_model
from nerif.geometry import Box, Camera, Rays
from nerif.geometry.plausibility import background_cuts, likely_cause, rays_on_lattice

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "Measurement",
    "Observation",
    "arguments_of",
    "cameras_of",
    "check_maps",
    "check_observations",
    "integrals_of",
]


@dataclass(frozen=True)
class Observation:
    """What the cameras saw by one technique.

    Parameters
    ----------
    technique : what a pixel measures
    values : (view, row, column, c) in the technique's unit; NaN where not measured
    sigma : (view, row, column, c) standard deviation of the noise, or None
    """

    technique: type[ForwardModel]
    values: Float[Tensor, "view row column c"]
    sigma: Float[Tensor, "view row column c"] | None = None

    @classmethod
    def of(cls, technique: type[ForwardModel], maps: Mapping[str, Tensor]) -> Observation:
        """Return the observation that maps hold, by their names in the file."""
        values, sigma = maps[technique.measured], maps.get(technique.sigma)
        whole = (*values.shape[:3], len(technique.channels))
        return cls(technique, values.reshape(whole), None if sigma is None else sigma.reshape(whole))

    @property
    def components(self) -> tuple[str, ...]:
        """What the channels are called: by their own names, or by what is measured where there is but one."""
        return tuple(name or self.technique.measured for name in self.technique.channels)

    @property
    def label(self) -> str:
        """What stands at a colour bar, with the unit."""
        return f"{self.technique.measured} [{self.technique.unit}]"

    @property
    def signed(self) -> bool:
        """Whether what is measured may be negative: not where the field may not."""
        return self.technique.bounds[0] < 0 and not self.technique.derived

    @property
    def caption(self) -> str:
        """What images of the views show."""
        kind = self.technique
        names = " and ".join(name for name in kind.channels if name)
        unit = f", in {kind.unit}" if unit_shown(kind.unit) else ""
        return f"{kind.measured.capitalize()} {names}".rstrip() + f" of each view{unit}"

    @property
    def maps(self) -> tuple[str, ...]:
        """Names of what a file holds of it."""
        return (self.technique.measured, self.technique.sigma, *self.technique.beside)

    def alone(self, measurement: Measurement) -> Measurement:
        """Return the measurement by this technique alone, of the views that measured something by it."""
        if len(measurement.observations) == 1:
            return measurement
        some, kind = _of_views_with(measurement, [self]), self.technique
        own = {name: value for name, value in some.measured_maps.items() if name in self.maps}
        return replace(some, cameras=tuple(kind.seen_by(c) for c in some.cameras), **arguments_of(own))

    def without(self, measurement: Measurement) -> Measurement:
        """Return the measurement by the other techniques, of the views that measured something by any of them."""
        others = [o for o in measurement.observations if o.technique is not self.technique]
        if len(others) == 1:
            return others[0].alone(measurement)
        some = _of_views_with(measurement, others)
        rest = {name: value for name, value in some.measured_maps.items() if name not in self.maps}
        return replace(some, **arguments_of(rest))

    def measured(self, view: int) -> Bool[Tensor, "row column"]:
        """Which pixels of a view have a value and, where it is known, a sigma within the limits of the technique."""
        least, most = self.technique.limits
        mask = (self.values[view].abs() <= most).all(dim=-1)  # NaN compares false
        if self.sigma is not None:
            mask &= ((self.sigma[view] >= least) & (self.sigma[view] <= most)).all(dim=-1)
        return mask


def integrals_of(measurement: Measurement) -> tuple[Observation, ...]:
    """Return the observations whose values are path integrals: all but images of a pattern.

    Raises
    ------
    InputError
        If there is none.
    """
    found = tuple(o for o in measurement.observations if not o.technique.derived)
    if not found:
        names = " and ".join(o.technique.measured for o in measurement.observations)
        raise InputError(
            f"expected displacements, got {names} alone; nerif displacement finds them", field="measurement"
        )
    return found


def _of_views_with(measurement: Measurement, observations: Sequence[Observation]) -> Measurement:
    """The measurement of the views that measured something by any of some techniques."""
    seen = torch.stack([measurement.usable_for(o).flatten(1).any(dim=1) for o in observations]).any(dim=0)
    return measurement.select([name for name, any_ in zip(measurement.names, seen.tolist(), strict=True) if any_])


def cameras_of(measurement: Measurement, views: Sequence[int]) -> tuple[Camera, ...]:
    """Return the cameras of some views, without their backgrounds where none of these measured by one."""
    cameras = tuple(measurement.cameras[i] for i in views)
    some = [o for o in measurement.observations if o.technique.background]
    if len(some) == len(measurement.observations) or any(bool(measurement.usable_for(o)[views].any()) for o in some):
        return cameras
    return tuple(c if c.background is None else c.without_background for c in cameras)


def arguments_of(maps: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return maps, by their names in the file, as a Measurement takes them; one channel may have an axis of its own."""
    plain = {name: value[..., 0] if value.shape[3:] == (1,) else value for name, value in maps.items()}
    return {"displacement": plain.pop("displacement", None), "sigma": plain.pop("sigma", None), "maps": plain}


def check_maps(measurement: Measurement) -> None:
    """Refuse a measurement of nothing, maps that no technique has, and maps and masks of the wrong shape.

    Raises
    ------
    InputError
        Naming what is wrong.
    """
    given, known = measurement.measured_maps, {kind.measured: kind for kind in TECHNIQUES.values()}
    first = next((name for name in known if name in given), None)
    if first is None:
        raise InputError(f"expected one of {', '.join(known)}, got none of them", field="measurement")
    shape = given[first].shape[:3]
    if len(measurement.cameras) != shape[0] or not measurement.cameras:
        raise InputError(f"expected one map a camera ({len(measurement.cameras)}), got {shape[0]}", field=first)
    expected = {"valid": tuple(shape), "flow_mask": tuple(shape)}
    for kind in known.values():
        whole = (*shape, len(kind.channels)) if len(kind.channels) > 1 else tuple(shape)
        expected |= {kind.measured: whole, kind.sigma: whole}
        for name, (channels, _) in kind.beside.items():
            expected[name] = (*shape, channels) if channels > 1 else tuple(shape)
    for name, value in {**given, "valid": measurement.valid, "flow_mask": measurement.flow_mask}.items():
        if name not in expected:
            raise InputError(f"expected names out of {', '.join(sorted(expected))}, got '{name}'", field="maps")
        if value is not None and tuple(value.shape) != expected[name]:
            axes = "view, row, column" + ", component" * (len(expected[name]) - 3)
            raise InputError(f"expected ({axes}) = {expected[name]}, got {tuple(value.shape)}", field=name)


def check_observations(measurement: Measurement) -> None:
    """Refuse what a technique cannot have measured, techniques that do not go together, and maps of none.

    Raises
    ------
    InputError
        Saying what is wrong, and what to do.
    """
    observations = measurement.observations
    names = " and ".join(o.technique.name for o in observations)
    if len({o.technique.quantity for o in observations}) > 1:
        raise InputError(
            f"expected techniques of one field, got {names}; split them into two measurements", field="technique"
        )
    _check_backgrounds(measurement, names)
    for o in observations:
        forward_model(o.technique, measurement)  # refuses what it lacks
        for i, (name, usable) in enumerate(zip(measurement.names, measurement.usable_for(o), strict=True)):
            try:
                o.technique.check(o.values[i], None if o.sigma is None else o.sigma[i], usable)
            except InputError as error:
                raise error.inside(f"view '{name}'") from None


def _check_backgrounds(measurement: Measurement, names: str) -> None:
    needed = any(o.technique.background for o in measurement.observations)
    for i, camera in enumerate(measurement.cameras):
        if camera.background is not None and not needed:
            raise InputError(
                f"expected none for {names}, got one; leave out background_normal and background_offset",
                field=f"background of view '{camera.name}'",
            )
        for o in measurement.observations:
            if o.technique.background and camera.background is None and bool(o.measured(i).any()):
                raise InputError(
                    f"expected a plane for {o.technique.name}, got none; give "
                    "background_normal and background_offset, or say which technique it is",
                    field=f"background of view '{camera.name}'",
                )


LIMITS_NM = (100.0, 30000.0)
"""Wavelengths from ultraviolet to thermal infrared, nm."""

CHUNK = 1 << 17
"""Pixels that are traced at a time."""


@dataclass(frozen=True)
class Measurement:
    """What was measured: cameras, what they saw, and the volume of interest.

    Parameters
    ----------
    cameras : one a view; their names are the names of the views
    displacement : (view, row, column, 2) d = p - p0 on the grid of the flow image, px; NaN where not measured; None for
        a measurement by other techniques alone
    box : Box, mm
    n_ambient : refractive index around the flow
    sigma : (view, row, column, 2) standard deviation of the displacement's noise, px, or None
    valid : (view, row, column) False where a pixel is not to be used, or None
    flow_mask : (view, row, column) True where there is flow, or None
    wavelength_nm : of the light, or None
    ambient_faces : faces of the box on which the index is ambient (the gauge)
    maps : (view, row, column) of other techniques, by their names in the file: absorbance, absorbance_sigma, radiance,
        radiance_sigma, fringes, fringes_sigma; NaN where not measured; (view, row, column, c) of one with c channels

    Raises
    ------
    InputError
        If nothing was measured, shapes disagree, a view has no valid pixel, values cannot be what their technique
        measures, a background is missing, needless or not behind the box, or no ray crosses the box.
    """

    cameras: tuple[Camera, ...]
    displacement: Float[Tensor, "view row column 2"] | None
    box: Box
    n_ambient: float
    sigma: Float[Tensor, "view row column 2"] | None = None
    valid: Bool[Tensor, "view row column"] | None = None
    flow_mask: Bool[Tensor, "view row column"] | None = None
    wavelength_nm: float | None = None
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES
    maps: Mapping[str, Float[Tensor, "view row column *c"]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._check_shapes()
        ambient_index(self.n_ambient)
        if self.wavelength_nm is not None and not LIMITS_NM[0] <= self.wavelength_nm <= LIMITS_NM[1]:
            raise InputError(f"expected nanometres such as 532, got {self.wavelength_nm}", field="wavelength_nm")
        parse_faces(self.ambient_faces)
        check_observations(self)
        good = self.usable.flatten(1).sum(dim=1)
        for name, count in zip(self.names, good.tolist(), strict=True):
            if count == 0:
                what = " and ".join(o.technique.measured for o in self.observations)
                raise InputError(
                    "no valid pixel; leave the view out or mend its mask", field=f"{what} of view '{name}'"
                )
        self._check_geometry()

    def _check_shapes(self) -> None:
        """Refuse maps of the wrong shape or name, before anything asks what was observed."""
        check_maps(self)
        shape = self.shape
        if len(set(self.names)) < len(self.names):
            raise InputError(f"expected different names, got {', '.join(self.names)}", field="view")
        if len({camera.lens is None for camera in self.cameras}) > 1:
            raise InputError(
                "expected of every view or of none (0 is a thin ray), got it of some", field="aperture_diameter"
            )
        for camera in self.cameras:
            if camera.image_size[0] > shape[1] or camera.image_size[1] > shape[2]:
                raise InputError(
                    f"expected at most {shape[1:3]} (height, width) px, got {camera.image_size}",
                    field=f"image_size of view '{camera.name}'",
                )

    def _check_geometry(self) -> None:
        """Refuse a background in front of or inside the box, and a box that no ray crosses."""
        crossing = False
        for camera in self.cameras:
            camera.check_distortion()
            rays = rays_on_lattice(camera, self.box)
            crossing |= bool(rays.crosses.any())
            if background_cuts(camera, self.box, rays):
                raise InputError(
                    f"background of view '{camera.name}': expected a plane behind the box as the camera sees it, got "
                    "one that cuts or stands before the box; check background_normal, background_offset (mm) and box; "
                    + likely_cause(self.cameras, self.box)
                )
        if not crossing:
            raise InputError(
                f"box: no ray of any view crosses it ({self.box.lower} to {self.box.upper} mm); "
                "check the box, and that rotation and translation map world to camera; "
                + likely_cause(self.cameras, self.box)
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the views."""
        return tuple(c.name for c in self.cameras)

    @cached_property
    def observations(self) -> tuple[Observation, ...]:
        """What was seen, technique by technique; a technique by which no pixel measured anything is none of them."""
        given = self.measured_maps
        found = [Observation.of(kind, given) for kind in TECHNIQUES.values() if kind.measured in given]
        some = [o for o in found if len(found) == 1 or bool(self.usable_for(o).any())]
        return tuple(some or found)

    @property
    def measured_maps(self) -> dict[str, Tensor]:
        """What has numbers for each pixel, by its name in the file."""
        given = {"displacement": self.displacement, "sigma": self.sigma, **self.maps}
        return {name: value for name, value in given.items() if value is not None}

    @property
    def displacements(self) -> Float[Tensor, "view row column 2"]:
        """The displacement.

        Raises
        ------
        InputError
            If none was measured.
        """
        if self.displacement is None:
            names = " and ".join(o.technique.measured for o in self.observations)
            raise InputError(f"expected a measurement of displacements, got {names}", field="displacement")
        return self.displacement

    @property
    def techniques(self) -> tuple[type[ForwardModel], ...]:
        """The techniques that something was measured by."""
        return tuple(o.technique for o in self.observations)

    @property
    def quantity(self) -> str:
        """The field that can be reconstructed."""
        return self.observations[0].technique.quantity

    @property
    def shape(self) -> tuple[int, int, int]:
        """Views, rows and columns of the maps."""
        views, rows, columns, *_ = next(iter(self.measured_maps.values())).shape
        return views, rows, columns

    def observed(self, values: Mapping[str, Tensor], sigmas: Mapping[str, Tensor | None] | None = None) -> Measurement:
        """Return the measurement with other values (view, row, column, c), and other sigmas, by technique name.

        A technique that is not named keeps its values; where sigmas are given, it loses its sigma.
        """
        new: dict[str, Tensor] = {}
        for o in self.observations:
            new[o.technique.measured] = values.get(o.technique.name, o.values)
            sigma = o.sigma if sigmas is None else sigmas.get(o.technique.name)
            if sigma is not None:
                new[o.technique.sigma] = sigma
            new |= {name: self.maps[name] for name in o.technique.beside if name in self.maps}
        return replace(self, **arguments_of(new))

    @property
    def usable(self) -> Bool[Tensor, "view row column"]:
        """Pixels inside their image, valid, by which one of the techniques measured something."""
        mask = self._called_valid
        for i in range(len(mask)):
            mask[i] &= self._measured(i)
        return mask

    def usable_for(self, observation: Observation) -> Bool[Tensor, "view row column"]:
        """Pixels inside their image, valid, by which one technique measured something."""
        mask = self._called_valid
        for i in range(len(mask)):
            mask[i] &= observation.measured(i)
        return mask

    @property
    def bad_pixels(self) -> int:
        """Pixels called valid that measured nothing (NaN, infinite or impossible numbers): masked, but worth a line."""
        mask = self._called_valid
        return sum(int((mask[i] & ~self._measured(i)).sum()) for i in range(len(mask)))

    @property
    def _called_valid(self) -> Bool[Tensor, "view row column"]:
        mask = self._inside
        return mask if self.valid is None else mask.logical_and_(self.valid)

    def _measured(self, view: int) -> Bool[Tensor, "row column"]:
        first, *others = (o.measured(view) for o in self.observations)
        for other in others:
            first |= other
        return first

    @property
    def _inside(self) -> Bool[Tensor, "view row column"]:
        mask = torch.zeros(self.shape, dtype=torch.bool)
        for i, camera in enumerate(self.cameras):
            mask[i, : camera.image_size[0], : camera.image_size[1]] = True
        return mask

    @property
    def pixel_sizes(self) -> tuple[float, ...]:
        """Width of a pixel of each view in the middle of the box, mm."""
        middle = torch.tensor(self.box.centre, dtype=torch.float64)
        return tuple(float(camera.pixel_size(middle)) for camera in self.cameras)

    @cached_property
    def sees_box(self) -> Bool[Tensor, "view row column"]:
        """Pixels whose rays cross the box on the way to the background."""
        mask = self._inside
        for _ in self._traced(mask, self.observations[0].technique, sensitivity=False):
            pass
        return mask

    def rays(
        self, observation: Observation | None = None
    ) -> tuple[Rays, Float[Tensor, "n c"], Float[Tensor, "n c"] | None]:
        """Return the usable rays that cross the box, what they measured by one technique, and its sigma or None.

        Parameters
        ----------
        observation : the first of the measurement where None
        """
        observation = observation or self.observations[0]
        mask = self.usable_for(observation)
        traced = self._traced(mask, observation.technique)
        rays = Rays.collect((part[keep] for part, keep in traced), int(mask.sum()))
        sigma = observation.sigma
        return rays, observation.values[mask].float(), None if sigma is None else sigma[mask].float()

    def _traced(
        self, mask: Bool[Tensor, "view row column"], kind: type[ForwardModel], sensitivity: bool = True
    ) -> Iterator[tuple[Rays, Bool[Tensor, " n"]]]:
        """Trace the pixels of a mask, some at a time, tell whose ray crosses the box, and clear the others in the mask.

        Rays are made in double precision: cameras stand far off, and positions lose digits in single precision.
        """
        for view, (camera, wanted) in enumerate(zip(self.cameras, mask, strict=True)):
            if not bool(wanted.any()):
                continue
            camera = kind.seen_by(camera)
            rows = max(1, CHUNK // wanted.shape[1])
            for first in range(0, wanted.shape[0], rows):
                block = wanted[first : first + rows]  # a view, through which the mask is changed
                row, column = block.nonzero().unbind(-1)
                pixels = torch.stack([column, row + first], dim=-1).to(camera.intrinsics.dtype)
                rays = camera.rays(pixels, sensitivity, view).clip(self.box)
                keep = rays.unobstructed
                block[row, column] = keep
                yield rays, keep

    def select(self, names: Sequence[str]) -> Measurement:
        """Return the measurement of the named views only.

        Raises
        ------
        InputError
            If there is no view of that name, or none is left.
        """
        for name in names:
            if name not in self.names:
                raise InputError(f"expected one of {', '.join(self.names)}, got '{name}'", field="view")
        index = [i for i, name in enumerate(self.names) if name in names]
        if not index:
            raise InputError(f"expected at least one of {', '.join(self.names)}, got none", field="view")
        if len(index) == len(self.cameras):
            return self

        def pick(x: Tensor | None) -> Tensor | None:
            return None if x is None else x[index]

        return replace(
            self,
            cameras=cameras_of(self, index),
            displacement=pick(self.displacement),
            sigma=pick(self.sigma),
            maps={name: value[index] for name, value in self.maps.items()},
            valid=pick(self.valid),
            flow_mask=pick(self.flow_mask),
        )

    def without(self, withheld: Sequence[str]) -> Measurement:
        """Return the measurement that is left to reconstruct from when some views are held out.

        Raises
        ------
        InputError
            If there is no view of that name, or none is left.
        """
        for name in withheld:
            if name not in self.names:
                raise InputError(f"expected views out of {', '.join(self.names)}, got '{name}'", field="withhold")
        kept = [name for name in self.names if name not in withheld]
        if not kept:
            raise InputError("every view is held out, so none is left to reconstruct from", field="withhold")
        return self.select(kept)

    def summary(self, withheld: int = 0) -> list[tuple[str, str]]:
        """Return what was measured as names and values with units; `withheld` of the views were not used."""
        from nerif.data.measurement_summary import summary

        return summary(self, withheld)

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the maps of the views, and the summary."""
        from nerif.data.measurement_summary import as_html

        return as_html(self)

    # -- files ---------------------------------------------------------------------------------------------------

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the file of docs/formats.md, atomically."""
        from nerif.data.measurement_file import encoding

        dataset = self.to_dataset()
        with atomic(path) as part:
            dataset.to_netcdf(part, engine="h5netcdf", encoding=encoding(dataset))

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Measurement:
        """Read a measurement file.

        Raises
        ------
        InputError
            If the file is missing, foreign, truncated, or breaks the contract; the message names the variable.
        """
        from nerif.data.measurement_file import CONVENTIONS

        with opened(path, f"a measurement (NetCDF-4, {CONVENTIONS})") as dataset:
            return cls.from_dataset(dataset)

    def to_dataset(self) -> xr.Dataset:
        """Return the variables and attributes of the file."""
        from nerif.data.measurement_file import to_dataset

        return to_dataset(self)

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset) -> Measurement:
        """Return the measurement that such variables and attributes describe.

        Raises
        ------
        InputError
            If they break the contract; the message names the variable.
        """
        from nerif.data.measurement_file import from_dataset

        return cls(**from_dataset(dataset))


def measurement_of(
    values: Mapping[type[ForwardModel], Float[Tensor, "view row column c"]],
    cameras: Sequence[Camera],
    box: Box,
    n_ambient: float,
    wavelength_nm: float | None = None,
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES,
) -> Measurement:
    """Return a measurement by one technique or more, with sigma 1 where there are more, from its values."""
    maps = {kind.measured: value for kind, value in values.items()}
    if len(values) > 1:
        maps |= {kind.sigma: torch.ones_like(value) for kind, value in values.items()}
    return Measurement(
        tuple(cameras), box=box, n_ambient=n_ambient, wavelength_nm=wavelength_nm, ambient_faces=ambient_faces,
        **arguments_of(maps),
    )  # fmt: skip
