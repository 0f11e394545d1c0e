"""What cameras saw by one technique, and whether it can be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError, unit_shown
from nerif.forward.base import ForwardModel
from nerif.forward.registry import TECHNIQUES, forward_model
from nerif.geometry import Camera

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement

__all__ = ["Observation", "arguments_of", "cameras_of", "check_maps", "check_observations", "integrals_of"]


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
        """What pictures of the views show."""
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
    """Return the observations whose values are path integrals: all but pictures of a pattern.

    Raises
    ------
    InputError
        If there is none.
    """
    found = tuple(o for o in measurement.observations if not o.technique.derived)
    if not found:
        names = " and ".join(o.technique.measured for o in measurement.observations)
        raise InputError(f"measurement: expected displacements, got {names} alone; nerif displacement finds them")
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
        raise InputError(f"measurement: expected one of {', '.join(known)}, got none of them")
    shape = given[first].shape[:3]
    if len(measurement.cameras) != shape[0] or not measurement.cameras:
        raise InputError(f"{first}: expected one map a camera ({len(measurement.cameras)}), got {shape[0]}")
    expected = {"valid": tuple(shape), "flow_mask": tuple(shape)}
    for kind in known.values():
        whole = (*shape, len(kind.channels)) if len(kind.channels) > 1 else tuple(shape)
        expected |= {kind.measured: whole, kind.sigma: whole}
        for name, (channels, _) in kind.beside.items():
            expected[name] = (*shape, channels) if channels > 1 else tuple(shape)
    for name, value in {**given, "valid": measurement.valid, "flow_mask": measurement.flow_mask}.items():
        if name not in expected:
            raise InputError(f"maps: expected names out of {', '.join(sorted(expected))}, got '{name}'")
        if value is not None and tuple(value.shape) != expected[name]:
            axes = "view, row, column" + ", component" * (len(expected[name]) - 3)
            raise InputError(f"{name}: expected ({axes}) = {expected[name]}, got {tuple(value.shape)}")


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
        raise InputError(f"technique: expected techniques of one field, got {names}; split them into two measurements")
    _check_backgrounds(measurement, names)
    for o in observations:
        forward_model(o.technique, measurement)  # refuses what it lacks
        for i, (name, usable) in enumerate(zip(measurement.names, measurement.usable_for(o), strict=True)):
            try:
                o.technique.check(o.values[i], None if o.sigma is None else o.sigma[i], usable)
            except InputError as error:
                raise InputError(f"view '{name}': {error}") from None


def _check_backgrounds(measurement: Measurement, names: str) -> None:
    needed = any(o.technique.background for o in measurement.observations)
    for i, camera in enumerate(measurement.cameras):
        if camera.background is not None and not needed:
            raise InputError(
                f"background of view '{camera.name}': expected none for {names}, got one; leave out "
                "background_normal and background_offset"
            )
        for o in measurement.observations:
            if o.technique.background and camera.background is None and bool(o.measured(i).any()):
                raise InputError(
                    f"background of view '{camera.name}': expected a plane for {o.technique.name}, got none; give "
                    "background_normal and background_offset, or say which technique it is"
                )
