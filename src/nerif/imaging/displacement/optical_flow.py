"""Optical flow by OpenCV, scikit-image and window correlation, with one signature.

Each takes the flow image and the reference, both float32 on a scale of 0 to 255, and returns the movement w (px) from
a point in the flow image to the same point of the pattern in the reference: flow(p) = reference(p + w(p)), d = -w.

Sources: DeepFlow: Weinzaepfel et al., ICCV 2013 (the paper's choice); DIS: Kroeger et al., ECCV 2016; TV-L1: Zach et
al., DAGM 2007; ILK: Le Besnerais & Champagnat, ICIP 2005.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nerif.imaging.displacement.correlation import window_correlation

__all__ = ["FLOWS"]


def deepflow(flow: np.ndarray, reference: np.ndarray, smoothness: float) -> np.ndarray:
    """OpenCV's DeepFlow; its smoothness is fixed."""
    import cv2

    return np.asarray(cv2.optflow.createOptFlow_DeepFlow().calc(flow, reference, None))  # type: ignore[call-overload]


def dis(flow: np.ndarray, reference: np.ndarray, smoothness: float) -> np.ndarray:
    """OpenCV's dense inverse search at full resolution, of 8-bit images."""
    import cv2

    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    method.setFinestScale(0)
    method.setPatchStride(2)
    method.setVariationalRefinementIterations(20)
    method.setVariationalRefinementAlpha(20.0 * smoothness)
    first, second = (np.clip(np.round(i), 0, 255).astype(np.uint8) for i in (flow, reference))
    return np.asarray(method.calc(first, second, None))  # type: ignore[call-overload]


def tvl1(flow: np.ndarray, reference: np.ndarray, smoothness: float) -> np.ndarray:
    """scikit-image's TV-L1."""
    from skimage.registration import optical_flow_tvl1

    v, u = optical_flow_tvl1(flow / 255, reference / 255, attachment=5 / smoothness, num_warp=10)
    return np.stack([u, v], axis=-1)


def ilk(flow: np.ndarray, reference: np.ndarray, smoothness: float) -> np.ndarray:
    """scikit-image's iterative Lucas-Kanade with Gaussian windows."""
    from skimage.registration import optical_flow_ilk

    radius = max(2, round(6 * smoothness))
    v, u = optical_flow_ilk(flow / 255, reference / 255, radius=radius, num_warp=10, gaussian=True)
    return np.stack([u, v], axis=-1)


def correlation(flow: np.ndarray, reference: np.ndarray, smoothness: float) -> np.ndarray:
    """Cross-correlation of interrogation windows, of 12 px at smoothness 1 (correlation.py)."""
    return window_correlation(flow, reference, window=max(8, 2 * round(6 * smoothness)))


FLOWS: dict[str, Callable[[np.ndarray, np.ndarray, float], np.ndarray]] = {
    method.__name__: method for method in (deepflow, dis, tvl1, ilk, correlation)
}
