"""A measurement without the mistakes that were found in it (consistency.py)."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from nerif.analysis.consistency import Consistency
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement, integrals_of
from nerif.mistakes import Correction

__all__ = ["corrected"]


def corrected(measurement: Measurement, found: Consistency) -> Measurement:
    """Return a measurement with the corrections of `found` applied, to sigma and masks as well.

    Pictures of the pattern are left out: they are not what was corrected.

    Parameters
    ----------
    measurement : that was compared, by one technique beside its pictures
    found : by check_consistency, of this measurement

    Raises
    ------
    InputError
        If there is nothing that can be undone, or there are several techniques, whose views share their masks.
    """
    observations = integrals_of(measurement)
    if len(observations) > 1:
        names = " and ".join(o.technique.name for o in observations)
        raise InputError(f"measurement: expected one technique to correct, got {names}; correct each file by itself")
    (observation,) = observations
    corrections = found.corrections.get(observation.technique.name, ())
    if not corrections:
        raise InputError("measurement: nothing was found in it that can be undone")
    alone = observation.alone(measurement)
    if alone.names != measurement.names:
        raise InputError("measurement: expected that every view measured something, for views are corrected by number")
    for correction in corrections:
        alone = _undone(correction, alone)
    return alone


def _undone(correction: Correction, measurement: Measurement) -> Measurement:
    (own,) = measurement.observations
    cameras, name = measurement.cameras, own.technique.name
    values = correction.undo(own.values, cameras)
    sigma = None if own.sigma is None else correction.undo(own.sigma, cameras).abs()
    channels = own.values.shape[-1]

    def mask(of: Tensor | None) -> Tensor | None:
        """A mask as a map of as many channels, so that it is turned and exchanged likewise."""
        if of is None:
            return None
        alike = of.to(own.values.dtype)[..., None].expand(*of.shape, channels).contiguous()
        return correction.undo(alike, cameras).abs()[..., 0] > 0.5

    mended = measurement.observed({name: values}, {name: sigma})
    return replace(mended, valid=mask(measurement.valid), flow_mask=mask(measurement.flow_mask))
