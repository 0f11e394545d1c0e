"""How good a reconstruction is: against a truth over the volume, and against measured views."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.analysis.alignment import aligned
from nerif.analysis.asymmetry import kept_half
from nerif.analysis.gains import gains_of, with_gains
from nerif.analysis.metrics import coverage, slice_metrics, view_metrics, volume_metrics
from nerif.analysis.prediction import check_sees, reproject
from nerif.analysis.residuals import leftover, white_noise
from nerif.common.conventions import InputError, with_unit
from nerif.data.measurement import Measurement, Observation
from nerif.data.reprojection import Reprojection
from nerif.data.volume import INDEX, Volume
from nerif.data.volume_file import read_volume
from nerif.fields.base import Field
from nerif.fields.grid import VoxelField
from nerif.forward.registry import AUTO, forward_model
from nerif.geometry import Box
from nerif.plotting.notebook import number
from nerif.reconstruction.aperture import seen_through
from nerif.reconstruction.rig.refined import with_corrections
from nerif.results.directory import METRICS, VOLUME, ResultDirectory

FLOW = 0.02  # share of the largest excess, above which a voxel counts as flow
ALIGNMENTS = ("none", "rigid")
AT_A_TIME = 8e6  # pixels of the views that are scored side by side: a megapixel takes some 0.1 GiB

__all__ = [
    "FLOW", "check_inside", "evaluate", "evaluate_aligned", "evaluate_views", "evaluate_volume", "rms_text",
    "score_lines",
]  # fmt: skip


def evaluate(
    result: str | os.PathLike[str],
    truth: str | os.PathLike[str] | None = None,
    measurement: str | os.PathLike[str] | None = None,
    withhold: Sequence[str] | None = None,
    on_view: Callable[[int, int], None] = lambda done, total: None,
    align: str = "none",
) -> dict[str, Any]:
    """Compare a result directory with a truth or with measured views; return the metrics, and add them to it.

    Views whose gains were fitted with the field are divided by them, as they were then.

    Parameters
    ----------
    result : directory of a reconstruction
    truth : volume file (.nc, .vti) of the true index, compared on its own grid
    measurement : measurement file to re-project into
    withhold : views of it which the reconstruction has not seen; None for those that run.toml held out
    on_view : told how many views are re-projected, out of how many
    align : "rigid" for the errors after the best rigid motion of the field as well, under `aligned`; or "none"

    Raises
    ------
    InputError
        If there is nothing to compare or to align, truth or measurement are of another quantity, the truth is over an
        unknown ambient or sticks out of the box, or there is no such view.
    """
    if truth is None and measurement is None:
        raise InputError("expected --truth VOLUME or --measurement FILE to compare with, got neither", field="evaluate")
    if align not in ALIGNMENTS:
        raise InputError(f"expected one of {', '.join(ALIGNMENTS)}, got '{align}'", field="align")
    if align != "none" and truth is None:
        raise InputError("expected together with --truth VOLUME, to which the field is moved, got none", field="align")
    directory = ResultDirectory(result)
    field, box, n_ambient = directory.field()
    quantity = directory.quantity()
    metrics: dict[str, Any] = {}
    data = None if measurement is None else Measurement.read(measurement)
    if data is not None:
        check_sees(data.techniques, quantity, str(measurement))
    if truth is not None:
        compared = _truth(Path(truth), box, n_ambient, quantity)
        metrics |= evaluate_volume(field, compared, n_ambient) | _coverage(directory, compared)
        if align == "rigid":
            metrics["aligned"] = evaluate_aligned(field, compared, n_ambient)
        metrics["quantity"] = quantity
        metrics["truth"] = str(Path(truth).resolve())
    if data is not None:
        asked = directory.settings()
        axis = directory.metrics().get("axis") if directory.has(METRICS) else None
        data, unseen = kept_half(data, asked.get("withhold", ()) if withhold is None else withhold, axis)
        withheld = _withheld(None if withhold is None else unseen, {**asked, "withhold": unseen}, data)
        aperture = "off" if asked.get("aperture", "off") == "off" else "auto"
        data = with_gains(seen_through(data, aperture), gains_of(asked))
        if directory.has(METRICS):
            data = with_corrections(data, directory.metrics().get("rig", []))
        views = reproject(field, data, withheld, on_view=on_view, model=str(asked.get("model", AUTO)))
        metrics |= {"views": evaluate_views(views), "reprojection": [a.entries for a in views.accuracies]}
        metrics["measurement"] = str(Path(str(measurement)).resolve())
        directory.write_reprojection(views)
    directory.add_metrics(metrics)
    return metrics


def evaluate_views(reprojection: Reprojection) -> list[dict[str, Any]]:
    """Compare every view with its prediction: cc, ssim, psnr and rms over the usable pixels that see the box.

    Of images it is the change by the flow that is compared: what they would show without it is taken off both.

    The rms is in the unit of what was measured, and also called rms_px where that is px. Where sigma is known,
    rms_over_sigma tells whether the residual is the noise (1) or more; leftover, where there are enough pixels, whether
    it is white, and of what it has the pattern if not (residuals.py). rms_measured, rms_predicted and rms_sigma are
    those of what was measured, of what is predicted and of sigma; rms_white that of the pixel-to-pixel noise. pixels
    counts what was compared.
    """
    from concurrent.futures import ThreadPoolExecutor

    measurement, sees_box = reprojection.measurement, reprojection.measurement.sees_box
    models = {kind: forward_model(kind, measurement) for kind in measurement.techniques if kind.derived}
    for model in models.values():
        model.prepare()

    def scores(view: int, observation: Observation, compared: Bool[Tensor, "view row column"]) -> dict[str, Any]:
        camera, kind = measurement.cameras[view], observation.technique
        height, width = camera.image_size
        inside = view, slice(0, height), slice(0, width)
        mask, predicted = compared[inside], reprojection.maps[kind.name][inside]
        measured = observation.values[inside].nan_to_num(0.0, 0.0, 0.0)
        found: dict[str, Any] = {"name": camera.name, "withheld": camera.name in reprojection.withheld}
        found |= {"measured": kind.measured, "unit": kind.unit}
        if kind.derived:  # what no flow would show is no merit of the field
            still = models[kind].to_map(torch.zeros(height, width, kind.integrals), view)
            measured, predicted = measured - still, predicted - still
        found |= view_metrics(measured.numpy(), predicted.numpy(), mask.numpy())
        if kind.unit != "1":
            found[f"rms_{kind.unit}"] = found["rms"]
        residual = measured - predicted
        found["pixels"] = int(mask.sum())
        found["rms_predicted"] = _rms(predicted[mask])
        found["rms_measured"] = _rms(measured[mask])
        if (white := white_noise(residual.nan_to_num(0.0, 0.0, 0.0).numpy(), mask.numpy())) is not None:
            found["rms_white"] = white
        if observation.sigma is not None and bool(mask.any()):
            found["rms_sigma"] = _rms(observation.sigma[inside][mask])
            residual = residual / observation.sigma[inside]
            found["rms_over_sigma"] = _rms(residual[mask])
        patterns = None if kind.derived else predicted.numpy()
        left = leftover(residual.nan_to_num(0.0, 0.0, 0.0).numpy(), patterns, mask.numpy())
        return found if left is None else {**found, "leftover": {**asdict(left), "alike": left.alike}}

    views: list[dict[str, Any]] = []
    side_by_side = int(min(torch.get_num_threads(), AT_A_TIME // sees_box[0].numel()))
    for o in measurement.observations:
        compared = measurement.usable_for(o) & sees_box
        # of several techniques a view has what it measured only
        chosen = [i for i in range(len(compared)) if len(measurement.observations) == 1 or bool(compared[i].any())]
        with ThreadPoolExecutor(max(side_by_side, 1)) as threads:
            views += threads.map(lambda i, o=o, compared=compared: scores(i, o, compared), chosen)
    return views


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())  # NaN of no pixels


def rms_text(view: dict[str, Any], digits: int = 4) -> str:
    """Return the rms error of a view with its unit."""
    return with_unit(number(view.get("rms"), digits), view["unit"])


def score_lines(views: list[dict[str, Any]]) -> list[str]:
    """Return a line for the training views and one for those held out, of each technique: the worst scores."""
    lines = []
    measured = dict.fromkeys(v["measured"] for v in views)
    groups = (("training view", False), ("held-out view", True))
    for (group, held), name in itertools.product(groups, measured):
        chosen = [v for v in views if v["withheld"] is held and v["measured"] == name]
        if chosen:
            cc = min(v["cc"] for v in chosen)
            rms = rms_text(max(chosen, key=lambda v: v["rms"]))
            noise = max(v.get("rms_over_sigma", float("nan")) for v in chosen)
            beside = "" if noise != noise else f", at most {noise:.2f} sigma"
            plural = "s" if len(chosen) > 1 else ""
            of = f", {name}" if len(measured) > 1 else ""
            lines.append(f"{len(chosen)} {group}{plural}{of}: CC at least {cc:.4f}, rms error at most {rms}{beside}")
    return lines


def evaluate_volume(
    field: Field, truth: Volume, n_ambient: float, device: torch.device | str = "cpu"
) -> dict[str, Any]:
    """Compare a field with a truth on the truth's own grid: see metrics.volume_metrics, and ten slices.

    Parameters
    ----------
    field : of the truth's quantity; of an index the excess over n_ambient
    truth : of an index the excess over the same ambient
    n_ambient : 1
    """
    rec = field.sample(truth.grid, device).numpy()
    gt = truth.values.numpy()
    heights = truth.grid.axis("z").numpy()
    beyond = n_ambient if truth.quantity == INDEX else 1.0  # the paper's L2 counts the ambient in
    return {**volume_metrics(gt, rec, beyond), "slices": slice_metrics(gt, rec, heights)}


def evaluate_aligned(field: Field, truth: Volume, n_ambient: float) -> dict[str, Any]:
    """Compare a field with a truth after the best rigid motion: its scores, and the motion, turn_rad and shift_mm."""
    moved = aligned(field, truth)
    scores = evaluate_volume(moved, truth, n_ambient)
    del scores["slices"]
    return {**scores, "turn_rad": moved.turn.tolist(), "shift_mm": moved.shift.tolist()}


def check_inside(path: Path, truth: Box, box: Box) -> None:
    """Refuse the truth of a file that sticks out of the reconstructed box."""
    sides = zip("xyz", truth.lower, truth.upper, box.lower, box.upper, strict=True)
    outside = [a for a, low, high, lower, upper in sides if low < lower - 1e-6 or high > upper + 1e-6]
    if outside:
        raise InputError(
            f"expected a volume inside the reconstructed box ({box.lower} to {box.upper} mm), "
            f"got one that sticks out along {', '.join(outside)}",
            field=path,
        )


def _truth(path: Path, box: Box, n_ambient: float, quantity: str) -> Volume:
    """The truth, as index excess over the ambient of the reconstruction; refused where it sticks out of the box."""
    truth = read_volume(path, None if quantity == INDEX else quantity)
    check_inside(path, truth.grid.box, box)
    if quantity != INDEX:
        return truth
    try:
        return truth.relative_to(n_ambient)
    except InputError as error:
        raise error.inside(path) from None


def _withheld(asked: Sequence[str] | None, settings: dict[str, Any], measurement: Measurement) -> tuple[str, ...]:
    """Names of the views that the reconstruction has not seen."""
    if asked is None:
        return tuple(name for name in settings.get("withhold", ()) if name in measurement.names)
    unknown = [name for name in asked if name not in measurement.names]
    if unknown:
        raise InputError(f"expected views out of {', '.join(measurement.names)}, got '{unknown[0]}'", field="withhold")
    return tuple(asked)


def _coverage(directory: ResultDirectory, truth: Volume) -> dict[str, Any]:
    """How often the truth lies within the standard deviations of the reconstruction, if there are any."""
    found = directory.volumes() if directory.has(VOLUME) else {}
    quantity = directory.quantity()
    if f"{quantity}_std" not in found:
        return {}

    def on_its_grid(volume: Volume) -> Float[Tensor, "z y x"]:
        if volume.grid == truth.grid:
            return volume.values
        return VoxelField.through(volume.values, volume.grid).sample(truth.grid)

    centre = on_its_grid(found[quantity])
    std = on_its_grid(found[f"{quantity}_std"])
    flow = truth.values.abs() > FLOW * truth.values.abs().max()
    return {"coverage": coverage((truth.values - centre).numpy(), std.numpy(), flow.numpy())}
