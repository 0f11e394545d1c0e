"""Bin the cells of a raw mosaic of colour filters: grey images of half the height and width.

    grey = 1/4 sum_k w_k I_k,      w_k = mean / mean_k

I_k are the four pixels of a cell. The weights make all four contribute equally, so that the centre of the cell is that
of the light. Pixel (r, c) of the binned image is centred on (2 r + 1/2, 2 c + 1/2) of the stored one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Shaped

from nerif.common.conventions import InputError
from nerif.imaging.readers.exposure import full_scale, saturated
from nerif.imaging.readers.frames import Frames

__all__ = ["Binning", "bin_mosaics", "binned_mask"]

LARGEST_WEIGHT = 4.0  # relative to the brightest filter: more would amplify the noise of a dark one


@dataclass(frozen=True)
class Binning:
    """Mean of each cell of 2 x 2 px of a raw mosaic; an odd last row or column is left out."""

    means: tuple[float, ...]  #: grey values at the places (0, 0), (0, 1), (1, 0), (1, 1) of the cells
    full_scale: float  #: grey value of a saturated pixel; a cell with such a pixel is saturated

    def __call__(self, image: Shaped[np.ndarray, "row column"]) -> Shaped[np.ndarray, "half_row half_column"]:
        """Return the binned image, of the same type."""
        means = np.maximum(self.means, max(*self.means, 1e-9) / LARGEST_WEIGHT).astype(np.float32)
        weights = means.mean() / means
        cells = _cells(image)
        grey = sum(weight * cell for weight, cell in zip(weights, cells, strict=True)) / np.float32(len(cells))
        brightest = np.maximum.reduce(cells)
        if image.dtype.kind == "u":
            grey = np.rint(grey)
        grey = np.minimum(grey, brightest).astype(image.dtype)  # weights never saturate a cell
        overexposed = np.logical_or.reduce(_cells(saturated(image, self.full_scale)))
        return np.where(overexposed, brightest, grey)


def _cells(image: np.ndarray) -> list[np.ndarray]:
    """The pixels at each of the four places of the cells."""
    height, width = (n // 2 * 2 for n in image.shape)
    return [image[r:height:2, c:width:2] for r in (0, 1) for c in (0, 1)]


def bin_mosaics(sources: Sequence[Frames], mosaic: str = "") -> None:
    """Bin the frames of all sources if those of one are a raw mosaic, with the weights of the first such source.

    Parameters
    ----------
    sources : frames of one camera; those of another size than the mosaic stay as they are
    mosaic : pattern, or "none"; "" for that of the metadata, else one recognised in the frames
    """
    readable = [frames for frames in sources if _is_readable(frames)]
    for frames in readable if mosaic != "none" else ():
        pattern = mosaic or frames.cfa or frames.layout.pattern
        if not pattern or min(frames.layout.shape) < 2:
            continue
        alike = [other for other in readable if other.layout.shape == frames.layout.shape]
        binning = Binning(frames.layout.means, full_scale(*alike))
        for other in alike:
            other.binning, other.mosaic = binning, pattern
        return


def _is_readable(frames: Frames) -> bool:
    try:
        return bool(frames.layout.shape)
    except InputError:  # reported when a frame is read
        return False


def binned_mask(mask: Bool[np.ndarray, "row column"]) -> Bool[np.ndarray, "half_row half_column"]:
    """Return where most pixels of a cell are inside a mask."""
    return np.asarray(np.add.reduce([cell.astype(np.uint8) for cell in _cells(mask)]) > 2)
