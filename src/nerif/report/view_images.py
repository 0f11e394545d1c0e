"""Measured, re-projected and difference of every view as small images for the page."""

from __future__ import annotations

import base64
import io
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import unit_shown
from nerif.data.measurement import Measurement, Observation
from nerif.data.reprojection import Reprojection
from nerif.plotting.drawing import map_colours, map_range

__all__ = ["Scale", "ViewImages", "colour_table", "image_address", "lattice_step", "view_images"]

LARGEST = 320  # px along an edge of an image in the page
ALL_IMAGES = 4_000_000  # px of all images of a page: 5 MB of it
FOR_LIMITS = 1 << 20  # px from which the ends of the colours are found


@dataclass(frozen=True)
class Scale:
    """Colours of what one technique measured, the same in all views.

    Parameters
    ----------
    measured : what was measured
    unit : of it, nothing for a pure number
    limits : ends of the colours of measured and re-projected
    apart : ends of the colours of the difference
    """

    measured: str
    unit: str
    limits: tuple[float, float]
    apart: tuple[float, float]


@dataclass(frozen=True)
class ViewImages:
    """The images of a view, as data addresses.

    Parameters
    ----------
    name : of the view
    withheld : the reconstruction has not seen it
    scores : cc, ssim, rms, rms_over_sigma as far as known, of each technique
    rows : by component, such as u and v: addresses of measured, re-projected, difference
    size : height and width of the view, px
    shrunk : how many rows and columns one pixel of the images stands for
    """

    name: str
    withheld: bool
    scores: list[dict[str, Any]]
    rows: dict[str, tuple[str, str, str]]
    size: tuple[int, int]
    shrunk: tuple[int, int]


def colour_table(name: str) -> list[tuple[int, int, int]]:
    """Return 256 colours (0 to 255) of a Matplotlib colour map."""
    from matplotlib import colormaps

    return [(int(r), int(g), int(b)) for r, g, b, _ in colormaps[name](np.arange(256), bytes=True)]


def lattice_step(measurement: Measurement, most: int) -> int:
    """Return the step, px, of the regular lattice on which a measurement has at most about `most` pixels."""
    views, height, width = measurement.shape
    return max(1, math.ceil(math.sqrt(views * height * width / most)))


def view_images(reprojection: Reprojection, metrics: list[dict[str, Any]]) -> tuple[list[ViewImages], list[Scale]]:
    """Return the images of all views, and the colours of each technique.

    Colours are those of all views: up to the 99.8th percentile of what was measured, the 99.5th of the difference; of
    more than a million pixels, on a regular lattice.
    """
    m = reprojection.measurement
    rows: list[dict[str, tuple[str, str, str]]] = [{} for _ in m.cameras]
    count = 3 * len(m.cameras) * sum(len(o.components) for o in m.observations)
    largest = min(LARGEST, math.isqrt(ALL_IMAGES // count))
    shrinks = [(-(-c.image_size[0] // largest), -(-c.image_size[1] // largest)) for c in m.cameras]
    scales = []
    for o in m.observations:
        usable, predicted = m.usable_for(o), reprojection.maps[o.technique.name]
        scale = _scale(reprojection, o)
        scales.append(scale)
        for i, camera in enumerate(m.cameras):
            inside = i, slice(0, camera.image_size[0]), slice(0, camera.image_size[1])
            valid = usable[inside][..., None].numpy()
            if len(m.observations) > 1 and not valid.any():
                continue
            measured, seen = np.where(valid, o.values[inside].numpy(), np.nan), predicted[inside].numpy()
            for c, component in enumerate(o.components):
                images = (measured[..., c], seen[..., c], seen[..., c] - measured[..., c])
                ends = (scale.limits, scale.limits, scale.apart)
                small = [_shrink(image, shrinks[i]) for image in images]
                first, second, third = (image_address(x, e) for x, e in zip(small, ends, strict=True))
                rows[i][component] = first, second, third
    found = [
        ViewImages(
            camera.name,
            camera.name in reprojection.withheld,
            [v for v in metrics if v.get("name") == camera.name],
            rows[i],
            camera.image_size,
            shrinks[i],
        )
        for i, camera in enumerate(m.cameras)
    ]
    return found, scales


def _scale(reprojection: Reprojection, observation: Observation) -> Scale:
    """The colours of one technique."""
    m, kind = reprojection.measurement, observation.technique
    usable, step = m.usable_for(observation), lattice_step(m, FOR_LIMITS)
    some = usable[:, ::step, ::step]
    if not bool(some.any()):
        step, some = 1, usable
    values = observation.values[:, ::step, ::step][some]
    apart = reprojection.maps[kind.name][:, ::step, ::step][some] - values
    return Scale(
        kind.measured,
        unit_shown(kind.unit),
        map_range(values.numpy(), observation.signed, 0.998),
        map_range(apart.numpy(), True, 0.995),
    )


def _shrink(image: Float[np.ndarray, "row column"], step: tuple[int, int]) -> Float[np.ndarray, "r c"]:
    """Mean of blocks of pixels, NaN where any is NaN; what is left over at the far edges is not shown."""
    (down, across), (height, width) = step, (n - n % s for n, s in zip(image.shape, step, strict=True))
    return image[:height, :width].reshape(height // down, down, width // across, across).mean(axis=(1, 3))


def image_address(
    image: Float[np.ndarray, "row column"], limits: tuple[float, float], colours: str = ""
) -> str:  # fmt: skip
    """Return a PNG of 255 colours between the limits, grey where there is nothing, as a data address.

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
