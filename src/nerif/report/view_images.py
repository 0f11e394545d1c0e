"""Measured, re-projected and difference of every view as small pictures for the page."""

from __future__ import annotations

import base64
import io
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from nerif.drawing import DIVERGING
from nerif.measurement import Measurement
from nerif.reprojection import Reprojection

__all__ = ["ViewImages", "colour_table", "lattice_step", "view_images"]

LARGEST = 320  # px along an edge of a picture in the page
ALL_PICTURES = 4_000_000  # px of all pictures of a page: 5 MB of it
FOR_LIMITS = 1 << 20  # px from which the ends of the colours are found


@dataclass(frozen=True)
class ViewImages:
    """The six pictures of a view, as data addresses.

    Parameters
    ----------
    name : of the view
    held_out : the reconstruction has not seen it
    scores : cc, ssim, rms_px, rms_over_sigma as far as known
    rows : for u and v: addresses of measured, re-projected, difference
    size : height and width of the view, px
    shrunk : how many rows and columns one pixel of the pictures stands for
    """

    name: str
    held_out: bool
    scores: dict[str, Any]
    rows: dict[str, tuple[str, str, str]]
    size: tuple[int, int]
    shrunk: tuple[int, int]


def colour_table(name: str) -> list[tuple[int, int, int]]:
    """Return 256 colours (0 to 255) of a Matplotlib colour map."""
    from matplotlib import colormaps

    return [(int(r), int(g), int(b)) for r, g, b, _ in colormaps[name](np.arange(256), bytes=True)]


def lattice_step(measurement: Measurement, most: int) -> int:
    """Return the step, px, of the regular lattice on which a measurement has at most about `most` pixels."""
    views, height, width, _ = measurement.displacements.shape
    return max(1, math.ceil(math.sqrt(views * height * width / most)))


def view_images(reprojection: Reprojection, metrics: list[dict[str, Any]]) -> tuple[list[ViewImages], float, float]:
    """Return the pictures of all views, the limit (px) of measured and re-projected, and that of the differences.

    Limits hold for all views: the 99.8th percentile of what was measured, the 99.5th of the difference; of more than a
    million pixels, on a regular lattice.
    """
    m = reprojection.measurement
    scores = {v.get("name"): v for v in metrics}
    usable = m.usable
    step = lattice_step(m, FOR_LIMITS)
    some = usable[:, ::step, ::step]
    if not bool(some.any()):
        step, some = 1, usable
    d, predicted = m.displacements[:, ::step, ::step][some], reprojection.predicted[:, ::step, ::step][some]
    limit = float(np.quantile(d.abs().flatten().numpy(), 0.998)) or 1.0
    apart = float(np.quantile((predicted - d).abs().flatten().numpy(), 0.995)) or 1.0
    largest = min(LARGEST, math.isqrt(ALL_PICTURES // (6 * len(m.cameras))))
    found = []
    for i, camera in enumerate(m.cameras):
        height, width = camera.image_size
        shrink = (-(-height // largest), -(-width // largest))
        valid = usable[i, :height, :width, None].numpy()
        measured = np.where(valid, m.displacements[i, :height, :width].numpy(), np.nan)
        seen = reprojection.predicted[i, :height, :width].numpy()
        rows = {}
        for c, component in enumerate("uv"):
            images = (measured[..., c], seen[..., c], seen[..., c] - measured[..., c])
            limits = (limit, limit, apart)
            small = [_shrink(image, shrink) for image in images]
            rows[component] = tuple(_picture(x, reach) for x, reach in zip(small, limits, strict=True))
        found.append(
            ViewImages(
                camera.name,
                camera.name in reprojection.held_out,
                scores.get(camera.name, {}),
                rows,  # type: ignore[arg-type]
                (height, width),
                shrink,
            )
        )
    return found, limit, apart


def _shrink(image: Float[np.ndarray, "row column"], step: tuple[int, int]) -> Float[np.ndarray, "r c"]:
    """Mean of blocks of pixels, NaN where any is NaN; what is left over at the far edges is not shown."""
    (down, across), (height, width) = step, (n - n % s for n, s in zip(image.shape, step, strict=True))
    return image[:height, :width].reshape(height // down, down, width // across, across).mean(axis=(1, 3))


def _picture(image: Float[np.ndarray, "row column"], limit: float) -> str:
    """A PNG of 255 colours from -limit to limit, and grey where there is nothing."""
    from PIL import Image

    scaled = np.clip((np.nan_to_num(image) / limit + 1) / 2, 0, 1) * 254
    codes = np.where(np.isfinite(image), np.round(scaled), 255).astype(np.uint8)
    table = colour_table(DIVERGING)
    palette = [c for i in range(255) for c in table[round(i * 255 / 254)]] + [190, 190, 190]
    picture = Image.fromarray(codes)
    picture.putpalette(palette)
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
