"""Quality of the images of a view: number, exposure, errors; and small JPEGs of them."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.imaging.quality.reference_outliers import flow_thumbnail, outliers
from nerif.imaging.quality.thumbnails import Thumbnail
from nerif.imaging.readers.exposure import check_exposure, full_scale, saturated
from nerif.imaging.readers.frames import as_float
from nerif.imaging.readers.views import View, read_sample

__all__ = ["ImageQuality", "image_quality", "jpeg_address", "shrink"]

HISTOGRAM_BINS = 64
JPEG_QUALITY = 85
WHITE = 0.999, 1.05  # quantile of the grey values, and ratio of white to it


@dataclass(frozen=True)
class ImageQuality:
    """Quality of the images of one source of a view."""

    count: int  #: number of images
    sampled: int  #: number of images read
    shape: tuple[int, int]  #: height and width of the view's part of a frame, px
    frame_shape: tuple[int, int]  #: height and width of a frame, px
    full: float  #: grey value of a saturated pixel
    saturated: float  #: share of saturated pixels in the first good image
    histogram: Float[np.ndarray, " bin"]  #: share of its pixels per bin from 0 to full scale
    bad: tuple[tuple[str, str], ...]  #: names of unusable images, and why
    notes: tuple[str, ...]  #: how the files are read, and warnings about them and of bad exposure
    first: int  #: number of the first good image


def image_quality(view: View, source: str, most: int = 12) -> ImageQuality:
    """Read `most` evenly spread images of a source such as "reference" or "flow" (0: all), and return their quality."""
    frames, sampled = view.open(source), 0
    bad: list[tuple[str, str]] = []
    notes = list(view.notes(source))
    good: tuple[int, np.ndarray] | None = None
    checks: list[tuple[str, Thumbnail, float]] = []
    for i, name, image in read_sample(view, source, most):
        sampled += 1
        if isinstance(image, InputError):
            bad.append((name, str(image).removeprefix(f"{name}: ")))
            continue
        if note := check_exposure(image, full_scale(frames), name):
            notes.append(note)
        good = good or (i, image)
        if source == "reference":
            checks.append((name, Thumbnail.of(image), float(np.mean(saturated(image, full_scale(frames))))))
    if good is not None and checks:
        names, thumbnails, shares = zip(*checks, strict=True)
        shape = good[1].shape
        result = outliers(thumbnails, shares, lambda: flow_thumbnail(view, shape))
        bad += [(names[k], reason) for k, reason in sorted(result.reasons.items())]
        notes += [f"view '{view.name}': {result.note}"] if result.note else []
    if good is None:
        name, why = bad[0]
        raise InputError(
            f"none of its {len(frames)} {source} images can be used; {name}: {why}", field=f"view '{view.name}'"
        )
    first, image = good
    full = full_scale(frames)
    counts, _ = np.histogram(image, bins=HISTOGRAM_BINS, range=(0, max(full, float(image.max()))))
    return ImageQuality(
        len(frames), sampled, (image.shape[0], image.shape[1]), frames.shape, full,
        float(np.mean(saturated(image, full))), counts / image.size, tuple(bad), tuple(notes), first,
    )  # fmt: skip


def shrink(image: np.ndarray, largest: int) -> np.ndarray:
    """Return an image whose longer side is at most `largest` px, averaged over pixels."""
    import cv2

    factor = largest / max(image.shape)
    if factor >= 1:
        return image
    height, width = (max(1, round(n * factor)) for n in image.shape)
    return np.asarray(cv2.resize(as_float(image), (width, height), interpolation=cv2.INTER_AREA))


def jpeg_address(image: np.ndarray, largest: int) -> str:
    """Return a grey image (row, column) from 0 as a JPEG in a data address, its longer side at most `largest` px.

    White is just above almost all grey values.
    """
    import cv2

    small = shrink(image, largest)
    quantile, ratio = WHITE
    top = max(float(np.quantile(small, quantile)) * ratio, 1e-9)
    grey = np.clip(small.astype(np.float32) * (255 / top), 0, 255).round().astype(np.uint8)
    _, data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
