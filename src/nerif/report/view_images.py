"""Measurement, prediction and residual of every view as small images for a page."""

from __future__ import annotations

import base64
import io
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nerif.common.blocks import blocks
from nerif.common.conventions import unit_shown
from nerif.data.measurement import Measurement
from nerif.data.measurement_data import Observation
from nerif.data.reprojection import Reprojection
from nerif.plotting.drawing import map_colours, map_range
from nerif.results.metrics_file import ViewScores

__all__ = ["ColourScale", "PageView", "colour_table", "image_address", "lattice_step", "view_images"]

MAX_PIXELS = 320  # along an edge of an image
MAX_PAGE_PIXELS = 4_000_000  # of all images: 5 MB of the page
SCALE_PIXELS = 1 << 20  # from which the ends of the colours are computed


@dataclass(frozen=True)
class ColourScale:
    """Colours of a measured quantity, the same in all views."""

    measured: str  #: the quantity
    unit: str  #: "" if dimensionless
    limits: tuple[float, float]  #: ends of the colours of measurement and prediction
    difference_limits: tuple[float, float]  #: ends of the colours of the residual


@dataclass(frozen=True)
class PageView:
    """The images of a view, as data addresses."""

    name: str  #: of the view
    withheld: bool  #: whether the reconstruction did not use it
    scores: list[ViewScores]  #: cc, ssim, rms, rms_over_sigma of each technique
    rows: dict[str, tuple[str, str, str]]
    """By component, such as u and v: addresses of measurement, prediction, residual."""
    size: tuple[int, int]  #: height and width of the view, px
    bin_size: tuple[int, int]  #: pixels (rows, columns) of the view per pixel of the images


def colour_table(name: str) -> list[tuple[int, int, int]]:
    """Return the 256 colours (0 to 255) of a Matplotlib colour map."""
    from matplotlib import colormaps

    return [(int(r), int(g), int(b)) for r, g, b, _ in colormaps[name](np.arange(256), bytes=True)]


def lattice_step(measurement: Measurement, max_pixels: int) -> int:
    """Return the step, px, of the regular lattice with at most about `max_pixels` pixels of a measurement."""
    views, height, width = measurement.shape
    return max(1, math.ceil(math.sqrt(views * height * width / max_pixels)))


def view_images(reprojection: Reprojection, metrics: list[ViewScores]) -> tuple[list[PageView], list[ColourScale]]:
    """Return the images of all views, and the colours of each technique.

    The colour range is the 99.8th percentile of the measurement, the 99.5th of the residual, over all views.
    """
    m = reprojection.measurement
    rows: list[dict[str, tuple[str, str, str]]] = [{} for _ in m.cameras]
    count = 3 * len(m.cameras) * sum(len(o.components) for o in m.observations)
    edge = min(MAX_PIXELS, math.isqrt(MAX_PAGE_PIXELS // count))
    steps = [(-(-c.image_size[0] // edge), -(-c.image_size[1] // edge)) for c in m.cameras]
    scales = []
    for o in m.observations:
        usable, predictions = m.usable_for(o), reprojection.maps[o.technique.name]
        scale = _scale(reprojection, o)
        scales.append(scale)
        for i, camera in enumerate(m.cameras):
            inside = i, slice(0, camera.image_size[0]), slice(0, camera.image_size[1])
            valid = usable[inside][..., None].numpy()
            if len(m.observations) > 1 and not valid.any():
                continue
            measured, predicted = np.where(valid, o.values[inside].numpy(), np.nan), predictions[inside].numpy()
            for c, component in enumerate(o.components):
                images = (measured[..., c], predicted[..., c], predicted[..., c] - measured[..., c])
                ends = (scale.limits, scale.limits, scale.difference_limits)
                first, second, third = (
                    image_address(_shrink(x, steps[i]), e) for x, e in zip(images, ends, strict=True)
                )
                rows[i][component] = first, second, third
    views = []
    for camera, row, step in zip(m.cameras, rows, steps, strict=True):
        scores = [v for v in metrics if v.get("name") == camera.name]
        withheld = camera.name in reprojection.withheld
        views.append(PageView(camera.name, withheld, scores, row, camera.image_size, step))
    return views, scales


def _scale(reprojection: Reprojection, observation: Observation) -> ColourScale:
    m, kind = reprojection.measurement, observation.technique
    usable, step = m.usable_for(observation), lattice_step(m, SCALE_PIXELS)
    lattice = usable[:, ::step, ::step]
    if not bool(lattice.any()):
        step, lattice = 1, usable
    values = observation.values[:, ::step, ::step][lattice]
    difference = reprojection.maps[kind.name][:, ::step, ::step][lattice] - values
    limits = map_range(values.numpy(), observation.signed, 0.998)
    return ColourScale(kind.measured, unit_shown(kind.unit), limits, map_range(difference.numpy(), True, 0.995))


def _shrink(image: Float[np.ndarray, "row column"], step: tuple[int, int]) -> Float[np.ndarray, "r c"]:
    """Means of whole blocks of pixels, NaN where any is NaN."""
    return blocks(image, *step).mean(axis=(1, 3))


def image_address(image: Float[np.ndarray, "row column"], limits: tuple[float, float], colours: str = "") -> str:
    """Return a PNG of 255 colours between the limits, grey for NaN, as a data address.

    Parameters
    ----------
    colours : name of a Matplotlib colour map; that of maps (map_colours) if empty
    """
    from PIL import Image

    low, high = limits
    scaled = np.clip((np.nan_to_num(image) - low) / ((high - low) or 1.0), 0, 1) * 254
    codes = np.where(np.isfinite(image), np.round(scaled), 255).astype(np.uint8)
    table = colour_table(colours or map_colours(limits))
    palette = [c for i in range(255) for c in table[round(i * 255 / 254)]] + [190, 190, 190]
    png = Image.fromarray(codes)
    png.putpalette(palette)
    buffer = io.BytesIO()
    png.save(buffer, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
