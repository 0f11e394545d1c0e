"""Maps of the views of a measurement with one colour scale."""

from __future__ import annotations

from html import escape

import torch

from nerif.app.forms.elements import images_html
from nerif.data.measurement import Measurement
from nerif.data.measurement_data import integrals_of
from nerif.geometry import Camera
from nerif.imaging.imaging_settings import MaskSettings
from nerif.imaging.masks import with_flow_masks
from nerif.report.view_images import image_address

__all__ = ["magnitude_address", "maps_html", "threshold_address"]

PIXELS = 320  # along the longer edge of a map
QUANTILE = 0.995  # of the values, within the colour range


def maps_html(measurement: Measurement) -> str:
    """Return a row of maps for each view as HTML: components of the signal, sigma, valid pixels."""
    observation, *_ = integrals_of(measurement)
    usable = measurement.usable_for(observation)
    values = observation.values.where(usable[..., None], torch.nan)
    most = _largest(values.abs())
    least = -most if observation.signed else 0.0
    sigma = None if observation.sigma is None else observation.sigma[..., 0].where(usable, torch.nan)
    noisiest = 1.0 if sigma is None else _largest(sigma)
    unit = escape(observation.technique.unit)
    scale = f"Colours from {least:.3g} to {most:.3g} {unit} in all views"
    scale += "; grey: not valid." if sigma is None else f", of sigma from 0 to {noisiest:.3g} {unit}; grey: not valid."
    parts = [f"<p class=note>{scale}</p>"]
    for i, (camera, share) in enumerate(zip(measurement.cameras, measurement.valid_share(observation), strict=True)):
        part = _pixels(i, camera, PIXELS)
        images = {
            name: image_address(values[part][..., c].numpy(), (least, most))
            for c, name in enumerate(observation.components)
        }
        if sigma is not None:
            images["sigma"] = image_address(sigma[part].numpy(), (0.0, noisiest), "viridis")
        images["valid"] = image_address(usable[part].numpy().astype(float), (0.0, 1.0), "gray")
        row = images_html([(address, f"{name} of view {camera.name}", name) for name, address in images.items()])
        data = observation.technique.data_name()
        parts.append(f"<h3>{escape(camera.name)}, {share:.1%} valid pixels ({data})</h3>{row}")
    return "".join(parts)


def magnitude_address(measurement: Measurement, view: int) -> str:
    """Return the magnitude of the signal of a view as an image."""
    (observation, *_), part = integrals_of(measurement), _pixels(view, measurement.cameras[view], 3 * PIXELS)
    size = observation.values[part].norm(dim=-1).where(measurement.usable[part], torch.nan)
    return image_address(size.numpy(), (0.0, _largest(size)), "viridis")


def threshold_address(measurement: Measurement, view: int, settings: MaskSettings, sigma: float | None) -> str:
    """Return the threshold mask of a view as an image, white where the flow is."""
    name = measurement.names[view]
    masked = with_flow_masks(measurement.select([name]), settings, sigma)
    assert masked.flow_mask is not None
    height, width = measurement.cameras[view].image_size
    return image_address(masked.flow_mask[0, :height, :width].numpy().astype(float), (0.0, 1.0), "gray")


def _pixels(view: int, camera: Camera, limit: int) -> tuple[int, slice, slice]:
    """Return the index of the pixels of a view that an image with `limit` pixels along the longer edge shows."""
    height, width = camera.image_size
    step = -(-max(height, width) // limit)
    return view, slice(0, height, step), slice(0, width, step)


def _largest(values: torch.Tensor) -> float:
    """The 99.5 % quantile of the finite values, 1 if it is 0 or there are none."""
    finite = values[values.isfinite()].flatten()
    sample = finite[:: max(1, len(finite) // 1_000_000)]
    return float(sample.quantile(QUANTILE)) or 1.0 if len(sample) else 1.0
