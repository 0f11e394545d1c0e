"""Small pictures of a measurement by one technique, quick reconstructions from them, and what those predict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.analysis.prediction import predict_view
from nerif.data.measurement import Measurement, measurement_of
from nerif.fields.base import Field
from nerif.forward.path_integral import PathIntegral
from nerif.forward.registry import forward_model
from nerif.reconstruction.voxels.tikhonov import Tikhonov

__all__ = [
    "binned", "compare", "disagreement", "fit", "path_integral", "predicted_by_others", "values_of", "with_values",
    "without_spikes",
]  # fmt: skip

OF_GRADIENTS, OF_INTEGRALS = 3e-3, 3e-4  # weights by which views left out are predicted at their size, to some 10 %
SPIKE = 6.0  # times the 95th percentile: rays along a sharp edge, which no coarse reconstruction follows


def values_of(small: Measurement) -> Float[Tensor, "view row column c"]:
    """Return what was measured."""
    return small.observations[0].values


def with_values(small: Measurement, values: Float[Tensor, "view row column c"]) -> Measurement:
    """Return the measurement with other values."""
    return small.observed({small.observations[0].technique.name: values})


def path_integral(small: Measurement) -> PathIntegral:
    """Return what the technique sees of a field."""
    return PathIntegral(forward_model(small.observations[0].technique, small))


def binned(measurement: Measurement, longest: int) -> Measurement:
    """Return the measurement with pixels averaged in squares, so that no picture is longer than about `longest` px.

    Pictures of a few rows keep one, as high as their squares would be or as they are. A square counts if half of its
    pixels do; of a view so sparse that none would, if one does. Sigma and masks are left behind.
    """
    most = -(-max(max(c.image_size) for c in measurement.cameras) // longest)
    down, across = (max(1, min(most, *(c.image_size[i] for c in measurement.cameras))) for i in (0, 1))
    scale = torch.tensor([across, down], dtype=measurement.cameras[0].intrinsics.dtype)
    cameras = []
    for camera in measurement.cameras:
        k = camera.intrinsics.clone()
        k[:2, :2] /= scale[:, None]
        k[:2, 2] = (k[:2, 2] + 0.5) / scale - 0.5
        height, width = camera.image_size
        cameras.append(replace(camera, intrinsics=k, image_size=(height // down, width // across)))
    rows, columns = (n // bins for n, bins in zip(measurement.shape[1:], (down, across), strict=True))
    inside = (slice(0, rows * down), slice(0, columns * across))
    seen = measurement.observations[0]
    pixels = scale if seen.technique.in_pixels() else torch.ones(1)
    maps = []
    for values, usable in zip(seen.values, measurement.usable, strict=True):
        good = usable[inside].reshape(rows, down, columns, across)
        parts = torch.where(good[..., None], values[inside].reshape(rows, down, columns, across, -1), 0.0)
        count = good.sum(dim=(1, 3))[..., None]
        mean = parts.sum(dim=(1, 3)) / count.clamp_min(1) / pixels.to(values)
        mean = mean if seen.signed else mean.clamp_min(0)  # below it is noise, which without sigma would be refused
        enough = count * 2 >= down * across
        maps.append(torch.where(enough if bool(enough.any()) else count > 0, mean, torch.nan))
    return measurement_of(
        {seen.technique: torch.stack(maps)}, cameras, measurement.box, measurement.n_ambient, measurement.wavelength_nm,
        measurement.ambient_faces,
    )  # fmt: skip


def without_spikes(small: Measurement) -> Measurement:
    """Return the measurement without the few pixels whose value is far beyond all others that are not 0."""
    values = values_of(small)
    length = values.norm(dim=-1)
    some = length[length > 0]
    if not len(some):
        return small
    limit = SPIKE * torch.quantile(some[:: max(1, len(some) // 1_000_000)], 0.95)
    return with_values(small, torch.where((length <= limit)[..., None], values, torch.nan))


def fit(measurement: Measurement, voxels: int, weight: float = 0.0) -> tuple[Field, float]:
    """Return a quick reconstruction, and its objective; of weight 0 smooth enough to predict other views well."""
    weight = weight or (OF_GRADIENTS if measurement.observations[0].technique.gauge else OF_INTEGRALS)
    settings = Tikhonov(
        voxels=voxels, basis="linear", iterations=20, tolerance=1e-3, regularisation=weight, coarse_to_fine=False,
        hull=False, device="cpu",
    )  # fmt: skip
    result = settings(measurement)
    return result.field, float(result.history[-1]["objective"])


def predicted_by_others(
    small: Measurement, left_out: Sequence[int], voxels: int
) -> dict[int, Float[Tensor, "row column c"]]:
    """Return what the other views predict of those left out."""
    others = [name for i, name in enumerate(small.names) if i not in left_out]
    field, _ = fit(small.select(others), voxels)
    return {i: predict_view(field, small.cameras[i], path_integral(small), small.box) for i in left_out}


def compare(
    predicted: Float[Tensor, "row column c"], small: Measurement, view: int, measured: Tensor | None = None
) -> tuple[float, float]:
    """Return the correlation (about 0) of what is measured and predicted, and the factor between them."""
    height, width = small.cameras[view].image_size
    measured = (values_of(small)[view] if measured is None else measured)[:height, :width]
    good = torch.isfinite(measured).all(dim=-1)
    a, b = predicted[good].flatten(), measured[good].flatten()
    product = float((a * b).sum())
    return product / max(float(a.norm() * b.norm()), 1e-30), product / max(float(a.square().sum()), 1e-30)


def disagreement(predicted: Tensor, small: Measurement, view: int, measured: Tensor) -> float:
    """Return the share of what is measured that a prediction does not explain: 0 at best, 2 for the opposite."""
    correlation, _ = compare(predicted, small, view, measured)
    return 1 - correlation * abs(correlation)
