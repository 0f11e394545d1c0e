"""Error of a shift by the gradients of the pattern and the residual of the images; smoothing error; correlation."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Shaped

from nerif.imaging.readers.frames import as_float

__all__ = ["FLOOR", "local_correlation", "smoothing_error", "structure_variance"]

Grey = Shaped[np.ndarray, "row column"]
FLOOR = 1e-3  # px, lower limit of the error of an optical flow
WIDER = 1.5  # window of the smoothing error, over that of the method (docs/decisions/065)


def structure_variance(flow: Grey, prediction: Grey, reach: float) -> Float[np.ndarray, "row column 2"]:
    """Return the variance (px^2) of the shift between the flow image and the reference warped by it.

    cov = <r^2> (sum grad(I) grad(I)^T)^-1 with r the residual, over Gaussian windows of standard deviation `reach`.
    """
    from scipy.ndimage import gaussian_filter

    pixels = 4 * np.pi * reach**2  # effective number in a Gaussian window
    gv, gu = np.gradient(prediction.astype(np.float64))
    uu, vv, uv = (gaussian_filter(g, reach) * pixels for g in (gu * gu, gv * gv, gu * gv))
    residual = gaussian_filter((as_float(flow) - as_float(prediction)).astype(np.float64) ** 2, max(4.0, 2 * reach))
    determinant = np.maximum(uu * vv - uv**2, 1e-9 * (uu + vv) ** 2 + 1e-12)
    return np.stack([residual * vv / determinant, residual * uu / determinant], axis=-1)


def smoothing_error(d: Shaped[np.ndarray, "row column 2"], reach: float) -> Float[np.ndarray, "row column 2"]:
    """Return the local rms of the part of d that a Gaussian window of 1.5 reach removes, px.

    Of its square the largest value within the reach counts: of a front that is thinner than the window, the measured d
    shows neither the place nor the height.
    """
    from scipy.ndimage import gaussian_filter, maximum_filter

    d, edge = as_float(d), 2 * round(reach) + 1
    parts = [(d[..., k] - gaussian_filter(d[..., k], WIDER * reach)) ** 2 for k in range(2)]
    return np.sqrt(np.stack([gaussian_filter(maximum_filter(part, edge), reach) for part in parts], axis=-1))


def local_correlation(a: Grey, b: Grey, reach: float) -> Float[np.ndarray, "row column"]:
    """Return the correlation coefficient of two images over a Gaussian window."""
    from scipy.ndimage import gaussian_filter

    a, b = a.astype(np.float64), b.astype(np.float64)
    mean_a, mean_b = gaussian_filter(a, reach), gaussian_filter(b, reach)
    cross = gaussian_filter(a * b, reach) - mean_a * mean_b
    variance = (gaussian_filter(a * a, reach) - mean_a**2) * (gaussian_filter(b * b, reach) - mean_b**2)
    return cross / np.sqrt(np.maximum(variance, 1e-6))
