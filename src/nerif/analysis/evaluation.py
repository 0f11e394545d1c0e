"""Accuracy of a reconstruction: against a truth in the volume, and against measured views."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.analysis.alignment import aligned
from nerif.analysis.asymmetry import withhold_half
from nerif.analysis.gains import gains_of, with_gains
from nerif.analysis.image_edges import cut_edges
from nerif.analysis.metrics import FLOW, coverage, slice_metrics, view_metrics, volume_metrics
from nerif.analysis.prediction import check_sees, reproject
from nerif.analysis.residuals import white_noise, whiteness
from nerif.common.arrays import filled
from nerif.common.conventions import InputError, with_unit, within
from nerif.data.measurement import Measurement
from nerif.data.measurement_data import Observation
from nerif.data.quantity_names import INDEX
from nerif.data.reprojection import Reprojection
from nerif.data.volume import Volume
from nerif.data.volume_file import read_volume
from nerif.fields.field import Field
from nerif.fields.voxel_field import VoxelField
from nerif.forward.forward_model import masked_blur
from nerif.forward.images import Images
from nerif.forward.model_names import AUTO
from nerif.geometry import Box
from nerif.geometry.body import contained
from nerif.plotting.notebook import number
from nerif.reconstruction.aperture import apply_aperture
from nerif.reconstruction.rig_parameters import with_corrections
from nerif.results.directory import METRICS, VOLUME, ResultDirectory
from nerif.results.metrics_file import Metrics, ViewScores

ALIGNMENTS = ("none", "rigid")
WINDOWS = 0.5, 5.0  # px, standard deviations of windows of optical flow
PARALLEL_PIXELS = 8e6  # of the views that are scored at a time: about 0.1 GiB per megapixel

__all__ = [
    "check_inside", "evaluate", "evaluate_aligned", "evaluate_views", "evaluate_volume", "rms_with_unit",
    "score_lines",
]  # fmt: skip


def evaluate(
    result: str | os.PathLike[str], truth: str | os.PathLike[str] | None = None,
    measurement: str | os.PathLike[str] | None = None, withhold: Sequence[str] | None = None,
    on_view: Callable[[int, int], None] = lambda done, total: None, align: str = "none",
) -> dict[str, Any]:  # fmt: skip
    """Compare a result directory with a truth or with measured views; return the metrics and add them to it.

    Views whose gains were fitted with the field are divided by these gains.

    Parameters
    ----------
    result : directory of a reconstruction
    truth : volume file (.nc, .vti) of the true index, compared on its own grid
    measurement : measurement file to re-project into
    withhold : views of it that the reconstruction did not use; None for those in run.toml
    on_view : called with the numbers of re-projected views and of all views
    align : "rigid" to add the errors after the best rigid motion of the field, under `aligned`; or "none"
    """
    if truth is None and measurement is None:
        raise InputError("expected --truth VOLUME or --measurement FILE to compare with, got neither", field="evaluate")
    if align not in ALIGNMENTS:
        raise InputError(f"expected one of {', '.join(ALIGNMENTS)}, got '{align}'", field="align")
    if align != "none" and truth is None:
        raise InputError(
            "expected together with --truth VOLUME, to which the field is aligned, got none", field="align"
        )
    directory = ResultDirectory(result)
    field, box, n_ambient = directory.field()
    quantity = directory.quantity()
    metrics: dict[str, Any] = {}
    data = None if measurement is None else Measurement.read(measurement)
    if data is not None:
        check_sees(data.techniques, quantity, str(measurement))
    if truth is not None:
        compared = _truth(Path(truth), box, n_ambient, quantity)
        if bodies := directory.bodies():
            compared = compared.masked(contained(bodies, compared.grid.points()), "within a body")
        metrics |= evaluate_volume(field, compared, n_ambient) | _coverage(directory, compared)
        if align == "rigid":
            metrics["aligned"] = evaluate_aligned(field, compared, n_ambient)
        metrics["quantity"] = quantity
        metrics["truth"] = str(Path(truth).resolve())
    if data is not None:
        settings, stored = directory.settings(), directory.metrics() if directory.has(METRICS) else Metrics()
        length, faces = float(settings.get("extend_open_faces", 0.0)), tuple(settings.get("open_faces", ()))
        data = replace(data, box=data.box.grown(faces, length))
        data, names = withhold_half(data, settings.get("withhold", ()) if withhold is None else withhold, stored.axis)
        unknown = [name for name in names if name not in data.names]
        if unknown and withhold is not None:
            raise InputError(f"expected views of {', '.join(data.names)}, got '{unknown[0]}'", field="withhold")
        withheld = tuple(name for name in names if name in data.names)
        aperture = "off" if settings.get("aperture", "off") == "off" else "auto"
        data = with_gains(apply_aperture(data, aperture), gains_of(settings))
        data = with_corrections(data, stored.rig)
        views = reproject(field, data, withheld, on_view=on_view, model=str(settings.get("model", AUTO)))
        metrics |= {"views": evaluate_views(views), "reprojection": [a.entries for a in views.accuracies]}
        metrics["measurement"] = str(Path(str(measurement)).resolve())
        directory.write_reprojection(views)
    directory.add_metrics(**metrics)
    return metrics


def evaluate_views(reprojection: Reprojection) -> list[ViewScores]:
    """Compare every view with its prediction over the usable pixels whose rays cross the box.

    Of images, their changes by the flow are compared. Displacements that were derived from images are averages over
    windows, and are compared with averages of their prediction.
    """
    from concurrent.futures import ThreadPoolExecutor

    measurement, sees_box = reprojection.measurement, reprojection.measurement.sees_box
    images = Images.of(measurement, AUTO) if Images in measurement.techniques else None
    if images is not None:
        _ = images.references  # made before threads share them

    def scores(view: int, observation: Observation, valid: Bool[Tensor, "view row column"]) -> Any:
        camera, kind = measurement.cameras[view], observation.technique
        height, width = camera.image_size
        inside = view, slice(0, height), slice(0, width)
        mask, predicted = valid[inside], reprojection.maps[kind.name][inside]
        measured = observation.values[inside].nan_to_num(0.0, 0.0, 0.0)
        row: dict[str, Any] = {"name": camera.name, "withheld": camera.name in reprojection.withheld}
        row |= {"measured": kind.measured, "unit": kind.unit}
        if images is not None and kind is Images:
            still = images.to_map(torch.zeros(height, width, 2), view)
            measured, predicted = measured - still, predicted - still
        elif images is not None and kind.name == Images.derived:
            predicted = _by_windows(predicted, measured, mask)
        row |= view_metrics(measured.numpy(), predicted.numpy(), mask.numpy())
        residual = measured - predicted
        row |= {"pixels": int(mask.sum()), "rms_predicted": _rms(predicted[mask]), "rms_measured": _rms(measured[mask])}
        if (white := white_noise(residual.nan_to_num(0.0, 0.0, 0.0).numpy(), mask.numpy())) is not None:
            row["rms_white"] = white
        if observation.sigma is not None and bool(mask.any()):
            row["rms_sigma"] = _rms(observation.sigma[inside][mask])
            residual = residual / observation.sigma[inside]
            row["rms_over_sigma"] = _rms(residual[mask])
        patterns = None if kind.derived else predicted.numpy()
        test = whiteness(residual.nan_to_num(0.0, 0.0, 0.0).numpy(), patterns, mask.numpy())
        return row if test is None else {**row, "residual_test": {**asdict(test), "correlated": test.correlated}}

    views: list[Any] = []
    threads = int(min(torch.get_num_threads(), PARALLEL_PIXELS // sees_box[0].numel()))
    for o in measurement.observations:
        valid = measurement.usable_for(o) & sees_box
        # with several techniques, a view has a row for each that it measured
        indices = [i for i in range(len(valid)) if len(measurement.observations) == 1 or bool(valid[i].any())]
        with ThreadPoolExecutor(max(threads, 1)) as pool:
            rows = dict(zip(indices, pool.map(lambda i, o=o, valid=valid: scores(i, o, valid), indices), strict=True))
        for edge in sorted(cut_edges(measurement, o), key=lambda edge: edge.signal):
            if edge.view in rows and not o.technique.derived:
                rows[edge.view] |= {"cut_edge": edge.side, "cut_signal": edge.signal}
        views += rows.values()
    return views


def _by_windows(
    predicted: Float[Tensor, "row column c"],
    measured: Float[Tensor, "row column c"],
    mask: Bool[Tensor, "row column"],
) -> Float[Tensor, "row column c"]:
    """The prediction, or its average over the Gaussian window with which it is nearest to the measurement."""
    from scipy.optimize import minimize_scalar

    finite = predicted.isfinite().all(dim=-1)

    def average(px: float) -> Float[Tensor, "row column c"]:
        return masked_blur(predicted, finite, px).to(predicted)

    def error(values: Float[Tensor, "row column c"]) -> float:
        return _rms((measured - values)[mask])

    if not bool(mask.any()):
        return predicted
    px = minimize_scalar(lambda px: error(average(px)), bounds=WINDOWS, method="bounded", options={"xatol": 0.03}).x
    return min(predicted, average(px), key=error)


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())  # NaN of no pixels


def rms_with_unit(view: ViewScores, digits: int = 4) -> str:
    """Return the rms residual of a view with its unit."""
    return with_unit(number(view.get("rms"), digits), view["unit"])


def score_lines(views: list[ViewScores]) -> list[str]:
    """Return a line with the worst scores of the fitted views and one of the withheld views, for each technique."""
    lines = []
    measured = dict.fromkeys(v["measured"] for v in views)
    for (role, withheld), name in itertools.product((("fitted", False), ("withheld", True)), measured):
        group = [v for v in views if v["withheld"] is withheld and v["measured"] == name]
        if group:
            cc = min(v["cc"] for v in group)
            rms = rms_with_unit(max(group, key=lambda v: v["rms"]))
            noise = max(v.get("rms_over_sigma", float("nan")) for v in group)
            in_sigma = "" if noise != noise else f", at most {noise:.2f} sigma"
            head = f"{len(group)} {role} view{'s' * (len(group) > 1)}{f', {name}' if len(measured) > 1 else ''}"
            lines.append(f"{head}: CC at least {cc:.4f}, rms residual at most {rms}{in_sigma}")
    return lines


def evaluate_volume(
    field: Field, truth: Volume, n_ambient: float, device: torch.device | str = "cpu"
) -> dict[str, Any]:
    """Compare a field with a truth of its quantity on the truth's grid: metrics.volume_metrics, and ten slices.

    Field and truth of an index are the excess over n_ambient.
    """
    rec = field.sample(truth.grid, device).numpy()
    gt = truth.values.numpy()
    heights = truth.grid.axis("z").numpy()
    offset = n_ambient if truth.quantity == INDEX else 1.0  # the paper's L2 includes the ambient
    return {**volume_metrics(gt, rec, offset), "slices": slice_metrics(gt, rec, heights)}


def evaluate_aligned(field: Field, truth: Volume, n_ambient: float) -> dict[str, Any]:
    """Compare a field with a truth after the best rigid motion; return the scores and rotation_rad, shift_mm."""
    moved = aligned(field, truth)
    scores = evaluate_volume(moved, truth, n_ambient)
    del scores["slices"]
    return {**scores, "rotation_rad": moved.turn.tolist(), "shift_mm": moved.shift.tolist()}


def check_inside(path: Path, truth: Box, box: Box) -> None:
    """Raise an error where the truth of a file extends beyond the reconstructed box."""
    sides = zip("xyz", truth.lower, truth.upper, box.lower, box.upper, strict=True)
    outside = [a for a, low, high, lower, upper in sides if low < lower - 1e-6 or high > upper + 1e-6]
    if outside:
        raise InputError(
            f"expected a volume inside the reconstructed box ({box.lower} to {box.upper} mm), "
            f"got one that extends beyond it along {', '.join(outside)}",
            field=path,
        )


def _truth(path: Path, box: Box, n_ambient: float, quantity: str) -> Volume:
    """The truth; of an index, as excess over the ambient of the reconstruction."""
    truth = read_volume(path, None if quantity == INDEX else quantity, gaps=True)
    check_inside(path, truth.grid.box, box)
    if quantity != INDEX:
        return truth
    with within(path):
        return truth.relative_to(n_ambient)


def _coverage(directory: ResultDirectory, truth: Volume) -> dict[str, Any]:
    """Coverage of the truth by the standard deviations of a result that has some."""
    volumes = directory.volumes() if directory.has(VOLUME) else {}
    quantity = directory.quantity()
    if f"{quantity}_std" not in volumes:
        return {}

    def on_its_grid(volume: Volume) -> Float[Tensor, "z y x"]:
        if volume.grid == truth.grid:
            return volume.values
        return VoxelField.through(torch.from_numpy(filled(volume.values.numpy())), volume.grid).sample(truth.grid)

    mean, std = on_its_grid(volumes[quantity]), on_its_grid(volumes[f"{quantity}_std"])
    outside = (truth.values + mean + std).isfinite()  # of bodies
    flow, size = truth.values[outside].abs(), truth.values.nan_to_num(0.0).abs().max()
    error, std = (truth.values - mean)[outside], std[outside]
    return {"coverage": coverage(error.numpy(), std.numpy(), (flow > FLOW * size).numpy())}
