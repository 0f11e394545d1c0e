"""A look at the images of a view: how many, how they are exposed, which cannot be read; and small ones to show."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.imaging.displacement.exposure import check_exposure, full_scale, saturated
from nerif.imaging.readers.frames import as_float, read_each
from nerif.imaging.readers.views import View

__all__ = ["SourceLook", "address_of", "look_at", "reduced"]

BINS = 64  # of a histogram
QUALITY = 85  # of JPEG
SHARPEST = 0.999, 1.05  # quantile of the grey values that is shown white, and how far above it white is


@dataclass(frozen=True)
class SourceLook:
    """What the images of one source of a view are like.

    Parameters
    ----------
    count, looked : images there are, and those that were read
    shape : height and width of the view's part of a frame, px
    frame_shape : height and width of a frame, px
    full : grey value of a full sensor
    saturated : share of the pixels of the first good image at which the sensor was full
    histogram : (bin,) share of its pixels from 0 to full scale
    bad : names of images that are of no use, and why
    notes : images that are badly exposed
    first : number of the first good image
    """

    count: int
    looked: int
    shape: tuple[int, int]
    frame_shape: tuple[int, int]
    full: float
    saturated: float
    histogram: Float[np.ndarray, " bin"]
    bad: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]
    first: int


def look_at(view: View, source: str, most: int = 12) -> SourceLook:
    """Read images of a source, evenly spread.

    Parameters
    ----------
    view : of find_views
    source : such as "reference" or "flow"
    most : number of images to read; 0 for all

    Raises
    ------
    InputError
        If the view has none, or none of those looked at can be used.
    """
    frames = view.open(source)
    count = len(frames)
    chosen = np.linspace(0, count - 1, min(most or count, count)).round().astype(int).tolist()
    bad: list[tuple[str, str]] = []
    notes: list[str] = []
    first: tuple[int, np.ndarray] | None = None
    for i, found in read_each(frames, chosen):
        name = frames.name(i)
        try:
            if isinstance(found, InputError):
                raise found
            image = view.cropped(found, name)
        except InputError as error:
            bad.append((name, str(error).removeprefix(f"{name}: ")))
            continue
        if note := check_exposure(image, full_scale(frames), name):
            notes.append(note)
        first = first or (i, image)
    if first is None:
        name, why = bad[0]
        raise InputError(f"none of its {count} {source} images can be used; {name}: {why}", field=f"view '{view.name}'")
    number, image = first
    full = full_scale(frames)
    counts, _ = np.histogram(image, bins=BINS, range=(0, max(full, float(image.max()))))
    return SourceLook(
        count, len(chosen), (image.shape[0], image.shape[1]), frames.shape, full,
        float(np.mean(saturated(image, full))), counts / image.size, tuple(bad), tuple(notes), number,
    )  # fmt: skip


def reduced(image: np.ndarray, largest: int) -> np.ndarray:
    """Return an image whose longer side is `largest` px at most, its pixels averaged."""
    import cv2

    factor = largest / max(image.shape)
    if factor >= 1:
        return image
    height, width = (max(1, round(n * factor)) for n in image.shape)
    return np.asarray(cv2.resize(as_float(image), (width, height), interpolation=cv2.INTER_AREA))


def address_of(image: np.ndarray, largest: int, white: float = 0.0) -> str:
    """Return a grey image as a JPEG in a data address, its longer side `largest` px at most.

    Parameters
    ----------
    image : (row, column) grey values from 0
    largest : px
    white : grey value that is shown white; where it is 0, a little above almost all values
    """
    import cv2

    small = reduced(image, largest)
    quantile, above = SHARPEST
    top = white or max(float(np.quantile(small, quantile)) * above, 1e-9)
    grey = np.clip(small.astype(np.float32) * (255 / top), 0, 255).round().astype(np.uint8)
    done, coded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done
    return "data:image/jpeg;base64," + base64.b64encode(coded.tobytes()).decode()
