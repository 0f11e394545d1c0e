"""Cameras, and the maps that they recorded by one technique or several: a measurement without its file."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.arrays import make_tensors
from nerif.common.axis_order import order_remedy
from nerif.common.conventions import DEFAULT_AMBIENT_FACES, InputError, ambient_index, parse_faces, unit_shown, within
from nerif.forward.forward_model import ForwardModel
from nerif.forward.registry import TECHNIQUES, forward_model
from nerif.geometry import Box, Camera, Rays
from nerif.geometry.body import Body
from nerif.geometry.plausibility import background_cuts, interface_cuts, likely_cause, rays_on_lattice
from nerif.geometry.region import Region, check_region

__all__ = ["MASKS", "MeasurementData", "Observation", "arguments_of", "integrals_of"]

MASKS = ("valid", "flow_mask", "hidden")
"""Fields of a measurement that are masks (view, row, column)."""
WAVELENGTHS_NM = (100.0, 30000.0)  # ultraviolet to thermal infrared
INDEX_TOLERANCE = 0.01  # of n_ambient, from the index behind the last interface
PIXELS_AT_A_TIME = 1 << 17  # whose rays are traced together
Data = TypeVar("Data", bound="MeasurementData")


@dataclass(frozen=True)
class Observation:
    """The maps of all views by one technique."""

    technique: type[ForwardModel]  #: quantity that a pixel measures
    values: Float[Tensor, "view row column c"]  #: (view, row, column, c) in the unit of the technique; NaN: no data
    sigma: Float[Tensor, "view row column c"] | None = None
    """(view, row, column, c) standard deviation of the noise, or None."""

    @classmethod
    def of(cls, technique: type[ForwardModel], maps: Mapping[str, Tensor]) -> Observation:
        """Return the observation in maps that have their names in the file."""
        values, sigma = maps[technique.measured], maps.get(technique.sigma)
        shape = (*values.shape[:3], len(technique.channels))
        return cls(technique, values.reshape(shape), None if sigma is None else sigma.reshape(shape))

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the channels; that of the map for a single one."""
        return tuple(name or self.technique.measured for name in self.technique.channels)

    @property
    def label(self) -> str:
        """Label of a colour bar."""
        return f"{self.technique.measured} [{self.technique.unit}]"

    @property
    def signed(self) -> bool:
        """Whether values may be negative."""
        return self.technique.bounds[0] < 0 and not self.technique.derived

    @property
    def caption(self) -> str:
        """Caption of a figure of the maps."""
        kind = self.technique
        names = " and ".join(name for name in kind.channels if name)
        unit = f", in {kind.unit}" if unit_shown(kind.unit) else ""
        return f"{kind.measured.capitalize()} {names}".rstrip() + f" of each view{unit}"

    @property
    def maps(self) -> tuple[str, ...]:
        """Names of its variables in a file."""
        return (self.technique.measured, self.technique.sigma, *self.technique.beside)

    def alone(self, measurement: Data) -> Data:
        """Return the measurement by this technique only, of the views that have data of it."""
        if len(measurement.observations) == 1:
            return measurement
        part, kind = _of_views_with(measurement, [self]), self.technique
        maps = {name: value for name, value in part.all_maps.items() if name in self.maps}
        return replace(part, cameras=tuple(kind.seen_by(c) for c in part.cameras), **arguments_of(maps))

    def without(self, measurement: Data) -> Data:
        """Return the measurement by the other techniques, of the views that have data of them."""
        others = [o for o in measurement.observations if o.technique is not self.technique]
        if len(others) == 1:
            return others[0].alone(measurement)
        part = _of_views_with(measurement, others)
        return replace(part, **arguments_of({n: value for n, value in part.all_maps.items() if n not in self.maps}))

    def valid(self, view: int) -> Bool[Tensor, "row column"]:
        """Return the pixels of a view whose value and sigma are finite and within the limits of the technique."""
        least, most = self.technique.limits
        mask = torch.ones(self.values.shape[1:3], dtype=torch.bool)
        for values in self.values[view].unbind(-1):
            mask &= values.abs() <= most  # NaN compares false
        if self.sigma is not None:
            for sigma in self.sigma[view].unbind(-1):
                mask &= (sigma >= least) & (sigma <= most)
        return mask


def integrals_of(measurement: MeasurementData) -> tuple[Observation, ...]:
    """Return the observations whose values are path integrals: all but images of a pattern."""
    integrals = tuple(o for o in measurement.observations if not o.technique.derived)
    if not integrals:
        raise InputError(
            f"expected displacements, got {_names(measurement)} only; run nerif displacement", field="measurement"
        )
    return integrals


def _names(measurement: MeasurementData) -> str:
    return " and ".join(o.technique.measured for o in measurement.observations)


def _of_views_with(measurement: Data, observations: Sequence[Observation]) -> Data:
    """Return the measurement of the views that have data of any of the observations."""
    data = torch.stack([measurement.usable_for(o).flatten(1).any(dim=1) for o in observations]).any(dim=0)
    return measurement.select([name for name, any_ in zip(measurement.names, data.tolist(), strict=True) if any_])


def arguments_of(maps: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return maps by their names in the file as arguments of Measurement, a single channel without its axis."""
    plain = {name: value[..., 0] if value.shape[3:] == (1,) else value for name, value in maps.items()}
    return {"displacement": plain.pop("displacement", None), "sigma": plain.pop("sigma", None), "maps": plain}


@dataclass(frozen=True, repr=False)
class MeasurementData:
    """Cameras, their maps, and the box to reconstruct.

    Parameters
    ----------
    cameras : one per view; their names are those of the views
    displacement : (view, row, column, 2) where a dot appears with flow minus where it appears without (px, u right,
        v down), on the grid of the flow image; NaN: no data; None for other
        techniques
    box : Box, mm
    n_ambient : refractive index around the flow
    sigma : (view, row, column, 2) standard deviation of the noise of the displacement, px, or None
    valid : (view, row, column) False for pixels to ignore, or None
    flow_mask : (view, row, column) True where there is flow, or None
    wavelength_nm : of the light, or None
    ambient_faces : faces of the box with ambient index (the gauge)
    ambient_region : box x0 x1 y0 y1 z0 z1 in mm with ambient index, down to a point, or None
    maps : (view, row, column) or (view, row, column, c) of other techniques, by their names in the file, such as
        absorbance and absorbance_sigma; NaN: no data
    frame_offsets : by the names of views: instant i is frame i + offset of the view's film; 0 if not named
    bodies : opaque bodies in the flow
    hidden : (view, row, column) True for pixels that see a body and have no data, or None

    Raises
    ------
    InputError
        If there are no data, shapes disagree, a view has no valid pixel, values are impossible for their technique, a
        background is missing, superfluous or not behind the box, or no ray crosses the box.
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
    frame_offsets: Mapping[str, int] = field(default_factory=dict)
    bodies: tuple[Body, ...] = ()
    hidden: Bool[Tensor, "view row column"] | None = None
    ambient_region: Region | None = None

    def __post_init__(self) -> None:
        make_tensors(self, torch.float32, "displacement", "sigma")
        make_tensors(self, torch.bool, *MASKS)
        object.__setattr__(self, "maps", {name: torch.as_tensor(value) for name, value in self.maps.items()})
        for camera in self.cameras:
            if not isinstance(camera, Camera):
                raise InputError(
                    f"expected records of Camera, got {type(camera).__name__}; its method camera() returns one",
                    field="cameras",
                )
        self._check_maps()
        self._check_views()
        ambient_index(self.n_ambient)
        if self.wavelength_nm is not None and not WAVELENGTHS_NM[0] <= self.wavelength_nm <= WAVELENGTHS_NM[1]:
            raise InputError(f"expected nanometres such as 532, got {self.wavelength_nm}", field="wavelength_nm")
        parse_faces(self.ambient_faces)
        if self.ambient_region is not None:
            check_region(self.ambient_region, self.box)
        self._check_observations()
        for name, any_ in zip(self.names, self.usable.flatten(1).any(dim=1).tolist(), strict=True):
            if not any_:
                raise InputError(
                    "no valid pixel; leave the view out or correct its mask", field=f"{_names(self)} of view '{name}'"
                )
        self._check_geometry()

    def _check_maps(self) -> None:
        """Check names and shapes of maps and masks."""
        maps, kinds = self.all_maps, {kind.measured: kind for kind in TECHNIQUES.values()}
        first = next((name for name in kinds if name in maps), None)
        if first is None:
            raise InputError(f"expected one of {', '.join(kinds)}, got none", field="measurement")
        if not self.cameras:
            raise InputError(f"expected one map per camera, got {len(maps[first])} and no camera", field=first)
        channels = dict.fromkeys(MASKS, 1)
        for kind in kinds.values():
            channels |= {kind.measured: len(kind.channels), kind.sigma: len(kind.channels)}
            channels |= {name: count for name, (count, _) in kind.beside.items()}
        every = {**maps, **{name: getattr(self, name) for name in MASKS}}
        for name in every:
            if name not in channels:
                raise InputError(f"expected names out of {', '.join(sorted(channels))}, got '{name}'", field="maps")
        shapes = {name: tuple(value.shape) for name, value in every.items() if value is not None}
        sizes = (len(self.cameras), *(max(camera.image_size[i] for camera in self.cameras) for i in (0, 1)))
        axes = ("view", "row", "column", "component")
        for name, shape in shapes.items():
            expected = (*sizes, channels[name])[: 4 if channels[name] > 1 else 3]
            if remedy := order_remedy(name, axes, expected, shape):
                raise InputError(
                    f"expected ({', '.join(axes[: len(expected)])}) = {expected} as the cameras, whose image_size is "
                    f"(height, width), got {shape}{remedy}",
                    field=name,
                )
        if shapes[first][0] != len(self.cameras):
            raise InputError(f"expected one map per camera ({len(self.cameras)}), got {shapes[first][0]}", field=first)
        for name, shape in shapes.items():
            expected = (*shapes[first][:3], channels[name])[: 4 if channels[name] > 1 else 3]
            if shape != expected:
                raise InputError(f"expected ({', '.join(axes[: len(expected)])}) = {expected}, got {shape}", field=name)

    def _check_views(self) -> None:
        _, rows, columns = self.shape
        if len(set(self.names)) < len(self.names):
            raise InputError(f"expected different names, got {', '.join(self.names)}", field="view")
        if len({camera.lens is None for camera in self.cameras}) > 1:
            raise InputError("expected for all views or none (0: thin rays)", field="aperture_diameter")
        swapped = all(c.image_size[0] <= columns and c.image_size[1] <= rows for c in self.cameras)
        for camera in self.cameras:
            if camera.image_size[0] > rows or camera.image_size[1] > columns:
                raise InputError(
                    f"expected at most {(rows, columns)} (height, width) px, the size of the maps, got "
                    f"{camera.image_size}{'; are rows and columns of the maps swapped?' * swapped}",
                    field=f"image_size of view '{camera.name}'",
                )

    def _check_observations(self) -> None:
        """Check that the techniques see the same field, have the backgrounds they need, and possible values."""
        names = " and ".join(kind.name for kind in self.techniques)
        if len({kind.quantity for kind in self.techniques}) > 1:
            raise InputError(
                f"expected techniques that see the same field, got {names}; split the measurement", field="technique"
            )
        for i, camera in enumerate(self.cameras):
            background = f"background of view '{camera.name}'"
            if camera.background is not None and not any(kind.background for kind in self.techniques):
                raise InputError(
                    f"expected none for {names}, got a plane; remove background_normal and background_offset",
                    field=background,
                )
            for o in self.observations:
                if o.technique.background and camera.background is None and bool(o.valid(i).any()):
                    raise InputError(
                        f"expected a plane for {o.technique.name}, got none; give background_normal and "
                        "background_offset, or state another technique",
                        field=background,
                    )
        for o in self.observations:
            forward_model(o.technique, self)  # raises where the technique needs more
            for i, (name, usable) in enumerate(zip(self.names, self.usable_for(o), strict=True)):
                with within(f"view '{name}'"):
                    o.technique.check(o.values[i], None if o.sigma is None else o.sigma[i], usable)

    def _check_geometry(self) -> None:
        """Check that backgrounds are behind the box and that rays cross it."""
        crossing = False
        for camera in self.cameras:
            camera.check_distortion()
            self._check_interfaces(camera)
            rays = rays_on_lattice(camera, self.box)
            crossing |= bool(rays.crosses.any())
            if background_cuts(camera, self.box, rays):
                raise InputError(
                    "expected a plane behind the box as the camera sees it, got one that cuts the box or lies in front "
                    "of it; check background_normal, background_offset (mm) and box; "
                    + likely_cause(self.cameras, self.box),
                    field=f"background of view '{camera.name}'",
                )
        if not crossing:
            raise InputError(
                f"no ray crosses it ({self.box.lower} to {self.box.upper} mm); check the box, and that rotation and "
                "translation map world to camera; " + likely_cause(self.cameras, self.box),
                field="box",
            )

    def _check_interfaces(self, camera: Camera) -> None:
        """Check that interfaces are in front of the box and lead into the medium around the flow."""
        if not camera.interfaces:
            return
        if interface_cuts(camera, self.box):
            raise InputError(
                "expected planes between the camera and the box, got one that cuts the box or lies behind it; check "
                "normal, offset (mm) and box",
                field=f"interfaces of view '{camera.name}'",
            )
        index = camera.interfaces[-1].index
        if self.quantity == "index_excess" and abs(index / self.n_ambient - 1) > INDEX_TOLERANCE:
            raise InputError(
                f"expected n_ambient = {self.n_ambient:g} behind the last plane, got {index:g}; give n_ambient of the "
                "medium around the flow, or the plane between glass and medium",
                field=f"interfaces of view '{camera.name}'",
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the views."""
        return tuple(c.name for c in self.cameras)

    @cached_property
    def observations(self) -> tuple[Observation, ...]:
        """The maps by technique, those without any usable pixel excluded."""
        maps = self.all_maps
        every = [Observation.of(kind, maps) for kind in TECHNIQUES.values() if kind.measured in maps]
        usable = [o for o in every if len(every) == 1 or bool(self._usable_for(o).any())]
        return tuple(usable or every)

    @property
    def all_maps(self) -> dict[str, Tensor]:
        """All maps by their names in the file, masks excluded."""
        maps = {"displacement": self.displacement, "sigma": self.sigma, **self.maps}
        return {name: value for name, value in maps.items() if value is not None}

    @property
    def displacements(self) -> Float[Tensor, "view row column 2"]:
        """The displacement; an InputError where there is none."""
        if self.displacement is None:
            raise InputError(f"expected displacements, got {_names(self)}", field="displacement")
        return self.displacement

    @property
    def techniques(self) -> tuple[type[ForwardModel], ...]:
        """The techniques of the observations."""
        return tuple(o.technique for o in self.observations)

    @property
    def quantity(self) -> str:
        """The field to reconstruct."""
        return self.observations[0].technique.quantity

    @property
    def shape(self) -> tuple[int, int, int]:
        """Views, rows and columns of the maps."""
        views, rows, columns, *_ = next(iter(self.all_maps.values())).shape
        return views, rows, columns

    def observed(self: Data, values: Mapping[str, Tensor], sigmas: Mapping[str, Tensor | None] | None = None) -> Data:
        """Return the measurement with other values (view, row, column, c) and sigmas, by technique name.

        A technique that is not named keeps its values; where sigmas are given, it loses its sigma.
        """
        maps: dict[str, Tensor] = {}
        for o in self.observations:
            maps[o.technique.measured] = values.get(o.technique.name, o.values)
            sigma = o.sigma if sigmas is None else sigmas.get(o.technique.name)
            if sigma is not None:
                maps[o.technique.sigma] = sigma
            maps |= {name: self.maps[name] for name in o.technique.beside if name in self.maps}
        return replace(self, **arguments_of(maps))

    @cached_property
    def usable(self) -> Bool[Tensor, "view row column"]:
        """Valid pixels inside their image with data of any technique; not to be changed."""
        mask = self._unmasked
        for i in range(len(mask)):
            mask[i] &= self._with_data(i)
        return mask

    def usable_for(self, observation: Observation) -> Bool[Tensor, "view row column"]:
        """Return the valid pixels inside their image with data of one technique."""
        if len(self.observations) == 1 and self.observations[0] is observation:
            return self.usable.clone()
        return self._usable_for(observation)

    def _usable_for(self, observation: Observation) -> Bool[Tensor, "view row column"]:
        mask = self._unmasked
        for i in range(len(mask)):
            mask[i] &= observation.valid(i)
        return mask

    def valid_share(self, observation: Observation) -> list[float]:
        """Return for each view the share of the pixels of its image that have valid data of a technique."""
        counts = self.usable_for(observation).flatten(1).sum(dim=1).tolist()
        return [n / (c.image_size[0] * c.image_size[1]) for n, c in zip(counts, self.cameras, strict=True)]

    @property
    def bad_pixels(self) -> int:
        """Number of pixels that are masked since they have no data: NaN, infinite or impossible numbers."""
        return int(self._unmasked.sum()) - int(self.usable.sum())

    @property
    def _unmasked(self) -> Bool[Tensor, "view row column"]:
        mask = self._inside
        if self.hidden is not None:
            mask.logical_and_(~self.hidden)
        return mask if self.valid is None else mask.logical_and_(self.valid)

    def _with_data(self, view: int) -> Bool[Tensor, "row column"]:
        first, *others = (o.valid(view) for o in self.observations)
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
        """Width of a pixel of each view at the centre of the box, mm."""
        centre = torch.tensor(self.box.centre, dtype=torch.float64)
        return tuple(float(camera.pixel_size(centre)) for camera in self.cameras)

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
        """Return the usable rays that cross the box, their values by one technique (default: the first), and sigma."""
        observation = observation or self.observations[0]
        mask = self.usable_for(observation)
        traced = self._traced(mask, observation.technique)
        rays = Rays.collect((part[keep] for part, keep in traced), int(mask.sum()))
        sigma = observation.sigma
        return rays, observation.values[mask].float(), None if sigma is None else sigma[mask].float()

    def _traced(
        self, mask: Bool[Tensor, "view row column"], kind: type[ForwardModel], sensitivity: bool = True
    ) -> Iterator[tuple[Rays, Bool[Tensor, " n"]]]:
        """Yield the rays of a mask in blocks, and which of them cross the box; clear the others in the mask.

        In double precision: cameras are far away, so positions in single precision would lose digits.
        """
        for view, (camera, pixels_of_view) in enumerate(zip(self.cameras, mask, strict=True)):
            if not bool(pixels_of_view.any()):
                continue
            camera = kind.seen_by(camera)
            rows = max(1, PIXELS_AT_A_TIME // pixels_of_view.shape[1])
            for first in range(0, pixels_of_view.shape[0], rows):
                block = pixels_of_view[first : first + rows]  # shares its memory with the mask
                row, column = block.nonzero().unbind(-1)
                pixels = torch.stack([column, row + first], dim=-1).to(camera.intrinsics.dtype)
                rays = camera.rays(pixels, sensitivity, view).clip(self.box)
                keep = rays.unobstructed
                block[row, column] = keep
                yield rays, keep

    def __getitem__(self: Data, names: str | Sequence[str]) -> Data:
        """Return the measurement of a view, or of some."""
        return self.select(names)

    def select(self: Data, names: str | Sequence[str]) -> Data:
        """Return the measurement of a view, or of some in their order here."""
        names = self._views(names, "view")
        index = [i for i, name in enumerate(self.names) if name in names]
        if not index:
            raise InputError(f"expected at least one of {', '.join(self.names)}, got none", field="view")
        if len(index) == len(self.cameras):
            return self

        return replace(self, cameras=self._cameras_of(index), **self.mapped(lambda x: x[index]))

    def mapped(self, change: Callable[[Tensor], Tensor]) -> dict[str, Any]:
        """Return all maps and masks, changed, as arguments of Measurement."""
        names = ("displacement", "sigma", *MASKS)
        present = {name: getattr(self, name) for name in names}
        changed: dict[str, Any] = {name: None if x is None else change(x) for name, x in present.items()}
        return changed | {"maps": {name: change(value) for name, value in self.maps.items()}}

    def _views(self, names: str | Sequence[str], field: str) -> tuple[str, ...]:
        """Return names of views, or a single one, if they exist."""
        if not isinstance(names, str) and not (isinstance(names, Sequence) and all(isinstance(n, str) for n in names)):
            remedy = "; measurement.names has them by number"
            raise InputError(f"expected names of views, such as '{self.names[0]}', got {names!r}{remedy}", field=field)
        names = (names,) if isinstance(names, str) else tuple(names)
        for name in names:
            if name not in self.names:
                nearest = difflib.get_close_matches(name, self.names, n=1)
                guess = f"; did you mean '{nearest[0]}'?" if nearest else ""
                raise InputError(f"expected views out of {', '.join(self.names)}, got '{name}'{guess}", field=field)
        return names

    def _cameras_of(self, views: Sequence[int]) -> tuple[Camera, ...]:
        """Return the cameras of some views, without backgrounds if none of the views has data that need one."""
        cameras = tuple(self.cameras[i] for i in views)
        needing = [o for o in self.observations if o.technique.background]
        if len(needing) == len(self.observations) or any(bool(self.usable_for(o)[views].any()) for o in needing):
            return cameras
        return tuple(c if c.background is None else c.without_background for c in cameras)

    def drop(self: Data, *names: str) -> Data:
        """Return the measurement without some views."""
        return self.without(names)

    def without(self: Data, withheld: str | Sequence[str]) -> Data:
        """Return the measurement of the other views."""
        withheld = self._views(withheld, "withhold")
        training = [name for name in self.names if name not in withheld]
        if not training:
            raise InputError("all views are withheld; leave one to reconstruct from", field="withhold")
        return self.select(training)

    def __repr__(self) -> str:
        (views, rows, columns), (x, y, z) = self.shape, self.box.edges
        kinds = ", ".join(o.technique.name for o in self.observations)
        sigma = "known" if all(o.sigma is not None for o in self.observations) else "unknown"
        views_of = f"{views} view{'s' * (views > 1)} of {rows} x {columns} px ({', '.join(self.names)})"
        return f"<Measurement of {kinds}: {views_of}, sigma {sigma}; box of {x:g} x {y:g} x {z:g} mm>"
