"""A short description of a measurement, and its display in a notebook."""

from __future__ import annotations

import torch

from nerif.common.conventions import with_unit
from nerif.data.measurement_data import MeasurementData, Observation
from nerif.forward.deflection import Deflection
from nerif.plotting.notebook import PIXELS, number, panel, show_views

__all__ = ["as_html", "summary", "valid_pixels"]


def summary(measurement: MeasurementData, withheld: int = 0) -> list[tuple[str, str]]:
    """Return names and values with units; `withheld`: number of views not used."""
    cameras = measurement.cameras
    sizes = sorted({c.image_size for c in cameras})
    unused = f" ({withheld} withheld)" if withheld else ""
    light = f" at {measurement.wavelength_nm:g} nm" if measurement.wavelength_nm else ""
    of_index = measurement.quantity == Deflection.quantity
    ambient = [("Ambient index", f"{measurement.n_ambient:.7g}{light}")] if of_index else []
    return [
        ("Views", f"{len(cameras)}{unused}, {' and '.join(f'{w} × {h}' for h, w in sizes[:3])} px"),
        *(row for observation in measurement.observations for row in _sizes(measurement, observation)),
        ("Valid pixels", valid_pixels(measurement)),
        *_lenses(measurement),
        ("Volume", " × ".join(f"{e:g}" for e in measurement.box.edges) + " mm (x, y, z)"),
        *ambient,
    ]


def valid_pixels(measurement: MeasurementData) -> str:
    """Return the share of valid pixels of all images; of each technique, if there are several."""
    sizes = torch.tensor([c.image_size for c in measurement.cameras], dtype=torch.float64).prod(dim=1)
    shares = {
        o.technique.data_name(): float((torch.tensor(measurement.valid_share(o)) * sizes).sum() / sizes.sum())
        for o in measurement.observations
    }
    several = len(shares) > 1
    return ", ".join(f"{share:.1%} ({name})" if several else f"{share:.1%}" for name, share in shares.items())


def _lenses(measurement: MeasurementData) -> list[tuple[str, str]]:
    diameters = sorted({c.lens.diameter for c in measurement.cameras if c.lens is not None} - {0.0})
    if not diameters:
        return []
    return [("Aperture", " to ".join(f"{d:.3g}" for d in diameters[:: max(len(diameters) - 1, 1)]) + " mm")]


def _sizes(measurement: MeasurementData, observation: Observation) -> list[tuple[str, str]]:
    """Return the sizes of values and noise of a technique, of rays that cross the box."""
    kind, usable = observation.technique, measurement.usable_for(observation) & measurement.sees_box
    squares, noise, largest = 0.0, 0.0, 0.0
    for i, mask in enumerate(usable):  # view by view: images may be large
        values = observation.values[i][mask].double()
        if len(values):
            squares, largest = squares + float(values.square().sum()), max(largest, float(values.abs().max()))
        if observation.sigma is not None:
            noise += float(observation.sigma[i][mask].double().square().sum())
    count = max(int(usable.sum()), 1) * len(kind.channels)
    sizes = ((squares / count) ** 0.5, (noise / count) ** 0.5, largest)
    rms, sigma, most = (with_unit(number(size, 3), kind.unit) for size in sizes)
    return [
        (kind.measured.capitalize(), f"rms {rms}, up to {most}"),
        ("Noise σ", "unknown" if observation.sigma is None else f"rms {sigma}"),
    ]


def as_html(measurement: MeasurementData) -> str:
    """Return the maps of the views by every technique, and the summary."""
    images = [(_image(measurement, o), o.caption) for o in measurement.observations]
    return panel("Measurement", summary(measurement), *images)


def _image(measurement: MeasurementData, observation: Observation) -> str:
    """Return the coarsened maps of the views with data of a technique."""
    usable, names, maps = measurement.usable_for(observation), [], []
    for i, camera in enumerate(measurement.cameras):
        height, width = camera.image_size
        step = -(-max(height, width) // PIXELS)
        part = i, slice(0, height, step), slice(0, width, step)
        if bool(usable[i].any()):
            names.append(camera.name)
            maps.append(torch.where(usable[part][..., None], observation.values[part], torch.nan).numpy())
    return show_views(names, maps, observation.components, observation.label, observation.signed)
