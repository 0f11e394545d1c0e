"""nerif evaluate: how close a reconstruction is to a truth, and to measured views."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from nerif.analysis.evaluation import FLOW, evaluate, rms_text
from nerif.cli.commands.output import counting_bar, say
from nerif.cli.commands.settings import Settings, read_settings
from nerif.common.conventions import InputError
from nerif.data.volume import INDEX, name_of

__all__ = ["Evaluate", "main", "run"]


@dataclass(frozen=True)
class Evaluate(Settings):
    """Compare a reconstruction with a truth over the volume, or with measured views; adds to its metrics.json."""

    result: Annotated[Path, tyro.conf.Positional]
    """Result directory of nerif reconstruct, or store of nerif sequence (.zarr)."""
    truth: Path | None = None
    """Volume file (.nc, .vti) of the true field, compared on its own grid; of a sequence NAME.truth.zarr."""
    measurement: Path | None = None
    """Measurement to re-project into."""
    align: str = "none"
    """Give errors after the best rigid motion of the field as well (rigid): what no camera can tell."""
    withhold: tuple[str, ...] | None = None
    """Views of that measurement which the reconstruction has not seen; default: those that run.toml held out."""


def run(settings: Evaluate) -> dict[str, Any]:
    """Print the metrics and return them."""
    if settings.result.suffix == ".zarr":
        return run_over_time(settings)
    with counting_bar("re-projecting") as bar:
        metrics = evaluate(
            settings.result, settings.truth, settings.measurement, settings.withhold, bar, settings.align
        )
    if settings.truth is not None:
        if "coverage" in metrics:
            share = metrics["coverage"]
            one, two = share["share_in_one_in_flow"], share["share_in_flow"]
            say(f"truth within 2 standard deviations in {share['share']:.1%} of the voxels; where the field is")
            say(f"  above {FLOW:.0%} of its largest, in {two:.1%} (95 % would be right), within 1 in {one:.1%} (68 %)")
        if metrics["quantity"] == INDEX:
            say(f"L2            {metrics['l2']:8.3%}   |n_gt - n_rec| / |n_gt - 1|, the paper's")
            say(f"L2 variation  {metrics['l2_variation']:8.3%}   |n_gt - n_rec| / |n_gt - n_ambient|")
        else:
            say(f"L2            {metrics['l2']:8.3%}   |f_gt - f_rec| / |f_gt| of the {name_of(metrics['quantity'])} f")
        if "aligned" in metrics:
            moved = math.hypot(*metrics["aligned"]["shift_mm"])
            turn = math.degrees(math.hypot(*metrics["aligned"]["turn_rad"]))
            motion = f"after a rigid motion of {moved:.3f} mm and {turn:.3f} degrees"
            say(f"L2 aligned    {metrics['aligned']['l2']:8.3%}   {motion}")
        say(f"CC            {metrics['cc']:8.5f}")
        say(f"SSIM          {metrics['ssim']:8.5f}")
        say(f"PSNR          {metrics['psnr']:8.2f} dB")
        say("   z [mm]      CC    SSIM   PSNR [dB]")
        for s in metrics["slices"]:
            say(f"{s['z_mm']:9.2f} {s['cc']:7.4f} {s['ssim']:7.4f} {s['psnr']:11.2f}")
    if settings.measurement is not None:
        several = len({v["measured"] for v in metrics["views"]}) > 1
        say(f"view          {' ' * 14 * several}      CC    SSIM  PSNR [dB]  rms")
        for v in metrics["views"]:
            held = "  held out" if v["withheld"] else ""
            name = f"{v['name']}, {v['measured']}" if several else v["name"]
            say(f"{name:<{14 + 14 * several}} {v['cc']:7.4f} {v['ssim']:7.4f} {v['psnr']:10.2f} {rms_text(v)}{held}")
    return metrics


def run_over_time(settings: Evaluate) -> dict[str, Any]:
    """Print the metrics of every frame of a sequence and return them."""
    from nerif.workflow.sequence.evaluation import evaluate_sequence

    if settings.truth is None or replace(settings, truth=None) != Evaluate(settings.result):
        raise InputError(
            "expected --truth NAME.truth.zarr alone for a sequence, whose views are compared already", field="evaluate"
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


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Evaluate(result=tyro.MISSING), arguments, "evaluate"))
