"""nerif evaluate: errors of a reconstruction against a true field, or against measured views."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from nerif.cli.output import counting_bar, say
from nerif.cli.settings import Settings, command
from nerif.common.conventions import InputError
from nerif.common.files import ending
from nerif.common.settings import Positional
from nerif.data.quantity_names import INDEX, name_of

if TYPE_CHECKING:
    from nerif.results.metrics_file import ViewScores

__all__ = ["Evaluate", "main", "run"]


@dataclass(frozen=True)
class Evaluate(Settings):
    """Compare a reconstruction with a true field or with measured views, and add the metrics to its metrics.json."""

    result: Annotated[Path, Positional]
    """Result directory of nerif reconstruct, or store of nerif sequence (.zarr)."""
    truth: Path | None = None
    """Volume of the true field (.nc, .vti), compared on its grid; NAME.truth.zarr for a sequence."""
    measurement: Path | None = None
    """Measurement to compare the re-projection with."""
    align: Literal["none", "rigid"] = "none"
    """Also report the error after the best rigid motion of the field (rigid), which the data do not constrain."""
    withhold: tuple[str, ...] | None = None
    """Withheld views of that measurement (default: those of run.toml)."""


def run(settings: Evaluate) -> dict[str, Any]:
    """Print the metrics and return them."""
    from nerif.analysis.evaluation import evaluate

    if ending(settings.result) == ".zarr":
        return _run_over_time(settings)
    with counting_bar("re-projecting") as bar:
        metrics = evaluate(
            settings.result, settings.truth, settings.measurement, settings.withhold, bar, settings.align
        )
    if settings.truth is not None:
        _print_volume(metrics)
    if settings.measurement is not None:
        _print_views(metrics["views"])
    return metrics


def _print_volume(metrics: dict[str, Any]) -> None:
    from nerif.analysis.metrics import FLOW

    if "coverage" in metrics:
        coverage = metrics["coverage"]
        one, two = coverage["one_sigma_in_flow"], coverage["two_sigma_in_flow"]
        say(f"truth within 2 standard deviations in {coverage['two_sigma']:.1%} of the voxels; where the field exceeds")
        say(f"  {FLOW:.0%} of its maximum: within 2 in {two:.1%} (nominal 95 %), within 1 in {one:.1%} (nominal 68 %)")
    if metrics["quantity"] == INDEX:
        say(f"L2            {metrics['l2']:8.3%}   |n_gt - n_rec| / |n_gt - 1|, as in the paper")
        say(f"L2 variation  {metrics['l2_variation']:8.3%}   |n_gt - n_rec| / |n_gt - n_ambient|")
    else:
        say(f"L2            {metrics['l2']:8.3%}   |f_gt - f_rec| / |f_gt| of the {name_of(metrics['quantity'])} f")
    if "aligned" in metrics:
        shift = math.hypot(*metrics["aligned"]["shift_mm"])
        rotation = math.degrees(math.hypot(*metrics["aligned"]["rotation_rad"]))
        motion = f"after a rigid motion of {shift:.3f} mm and {rotation:.3f} degrees"
        say(f"L2 aligned    {metrics['aligned']['l2']:8.3%}   {motion}")
    say(f"CC            {metrics['cc']:8.5f}")
    undefined = "   not defined: fewer than 7 voxels along an edge, or a truth that does not vary"
    say(f"SSIM          {metrics['ssim']:8.5f}{undefined if math.isnan(metrics['ssim']) else ''}")
    say(f"PSNR          {metrics['psnr']:8.2f} dB")
    say("   z [mm]      CC    SSIM   PSNR [dB]")
    for s in metrics["slices"]:
        line = f"{s['z_mm']:9.2f} {s['cc']:7.4f} {s['ssim']:7.4f} {s['psnr']:11.2f}"
        say(line if math.isfinite(s["cc"]) else f"{s['z_mm']:9.2f}   the truth does not vary")


def _print_views(views: list[ViewScores]) -> None:
    from nerif.analysis.evaluation import rms_with_unit

    several = len({v["measured"] for v in views}) > 1
    say(f"view          {' ' * 14 * several}      CC    SSIM  PSNR [dB]  rms")
    for v in views:
        name = f"{v['name']}, {v['measured']}" if several else v["name"]
        flag = "  withheld" if v["withheld"] else ""
        say(f"{name:<{14 + 14 * several}} {v['cc']:7.4f} {v['ssim']:7.4f} {v['psnr']:10.2f} {rms_with_unit(v)}{flag}")


def _run_over_time(settings: Evaluate) -> dict[str, Any]:
    from nerif.workflow.sequence.sequence_evaluation import evaluate_sequence

    if settings.truth is None or replace(settings, truth=None) != Evaluate(settings.result):
        raise InputError(
            "expected only --truth NAME.truth.zarr for a sequence, which has the scores of its views", field="evaluate"
        )
    with counting_bar("comparing frames") as bar:
        metrics = evaluate_sequence(settings.result, settings.truth, bar)
    say("frame   t [ms]        L2  L2 variation       CC")
    for f in metrics["frames"]:
        say(f"{f['frame']:5d} {f['time_s'] * 1e3:8.3f} {f['l2']:9.3%} {f['l2_variation']:13.3%} {f['cc']:8.5f}")
    mean = metrics["mean"]
    scores = f"L2 {mean['l2']:.3%}, of variation {mean['l2_variation']:.3%}, CC {mean['cc']:.5f}"
    say(f"mean of {len(metrics['frames'])} frames: {scores}")
    return metrics


main = command("evaluate", Evaluate, run)
