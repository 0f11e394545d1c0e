"""Where the flow is in a picture: by threshold, or drawn by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from nerif.conventions import InputError

__all__ = ["flow_mask", "read_mask"]


def flow_mask(
    displacement: Float[np.ndarray, "row column 2"],
    sigma: Float[np.ndarray, "row column 2"],
    threshold: float = 3.0,
    smooth: float = 1.5,
    smallest: int = 64,
    grow: int = 3,
) -> Bool[np.ndarray, "row column"]:
    """Return where |d| / sigma exceeds a threshold, cleaned up.

    Parameters
    ----------
    displacement : px; NaN counts as no flow
    sigma : px
    threshold : standard deviations
    smooth : standard deviation of a Gaussian over d / sigma, px
    smallest : islands and holes of fewer pixels are removed
    grow : px added all around, so that the edge of the flow is inside

    Raises
    ------
    InputError
        If a number is negative.
    """
    from scipy.ndimage import binary_dilation, gaussian_filter
    from skimage.morphology import remove_small_holes, remove_small_objects

    for name, value in (("threshold", threshold), ("smooth", smooth), ("smallest", smallest), ("grow", grow)):
        if not value >= 0:
            raise InputError(f"{name}: expected 0 or more, got {value}")
    ratio = np.nan_to_num(displacement / sigma, nan=0.0, posinf=0.0, neginf=0.0)
    if smooth:
        ratio = np.stack([gaussian_filter(ratio[..., k], smooth) for k in range(2)], axis=-1)
    mask = np.hypot(ratio[..., 0], ratio[..., 1]) > threshold
    if smallest:
        mask = remove_small_objects(mask, max_size=smallest)
        mask = remove_small_holes(mask, max_size=smallest)
    return np.asarray(binary_dilation(mask, iterations=grow) if grow else mask)


def read_mask(path: Path, shape: tuple[int, int]) -> Bool[np.ndarray, "row column"]:
    """Read a mask drawn as a picture: anything above half of its range counts.

    Raises
    ------
    InputError
        If it cannot be read, is of another size than the view, or of one grey.
    """
    from nerif.imaging.readers import open_frames

    image = open_frames(path)[0].astype(np.float64)
    if image.shape != shape:
        raise InputError(
            f"{path}: expected a mask of {shape[0]} x {shape[1]} px (height x width) as the view, got "
            f"{image.shape[0]} x {image.shape[1]}"
        )
    if image.min() == image.max():
        raise InputError(f"{path}: expected a mask with black and white in it, got one grey of {image.max():g}")
    return np.asarray(image > (image.min() + image.max()) / 2)
