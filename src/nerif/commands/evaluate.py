"""nerif evaluate: how close a reconstruction is to a truth, and to measured views."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from torch import Tensor

from nerif.commands.output import counting_bar, say
from nerif.commands.settings import Settings, read_settings, read_toml
from nerif.conventions import InputError
from nerif.evaluation import evaluate_views, evaluate_volume, reproject, update_json, write_json
from nerif.fields.grid import VoxelField
from nerif.measurement import Measurement
from nerif.reconstruction.files import read_field
from nerif.report.result import RUN, VOLUME
from nerif.reprojection import REPROJECTION
from nerif.volume import Volume, read_volume, read_volumes
from nerif.volume_sequence import VolumeSequence

FLOW = 0.02  # share of the largest excess, above which a voxel counts as flow

__all__ = ["Evaluate", "main", "run"]


@dataclass(frozen=True)
class Evaluate(Settings):
    """Compare a reconstruction with a truth over the volume, or with measured views; adds to its metrics.json."""

    result: Annotated[Path, tyro.conf.Positional]
    """Result directory of nerif reconstruct, or store of nerif sequence (.zarr)."""
    truth: Path | None = None
    """Volume file (.nc, .vti) of the true index, compared on its own grid; of a sequence NAME.truth.zarr."""
    measurement: Path | None = None
    """Measurement to re-project into."""
    hold_out: tuple[str, ...] | None = None
    """Views of that measurement which the reconstruction has not seen; default: those that run.toml held out."""


def run(settings: Evaluate) -> dict[str, Any]:
    """Print the metrics, keep them in metrics.json, and return them."""
    if settings.truth is None and settings.measurement is None:
        raise InputError("evaluate: expected --truth VOLUME or --measurement FILE to compare with, got neither")
    if settings.result.suffix == ".zarr":
        return run_over_time(settings)
    field, box, n_ambient = read_field(settings.result)
    metrics: dict[str, Any] = {}
    if settings.truth is not None:
        truth = read_volume(settings.truth)
        if truth.quantity != "index_excess":
            raise InputError(f"{settings.truth}: expected index_excess or n in it, got '{truth.quantity}'")
        outside = [
            a
            for i, a in enumerate("xyz")
            if truth.grid.box.lower[i] < box.lower[i] - 1e-6 or truth.grid.box.upper[i] > box.upper[i] + 1e-6
        ]
        if outside:
            raise InputError(
                f"{settings.truth}: expected a volume inside the reconstructed box ({box.lower} to {box.upper} mm), "
                f"got one that sticks out along {', '.join(outside)}"
            )
        metrics |= evaluate_volume(field, truth, n_ambient)
        metrics["truth"] = str(settings.truth.resolve())
        metrics |= _coverage(settings.result, truth)
        say(f"L2            {metrics['l2']:8.3%}   |n_gt - n_rec| / |n_gt - 1|, the paper's")
        say(f"L2 variation  {metrics['l2_variation']:8.3%}   |n_gt - n_rec| / |n_gt - n_ambient|")
        say(f"CC            {metrics['cc']:8.5f}")
        say(f"SSIM          {metrics['ssim']:8.5f}")
        say(f"PSNR          {metrics['psnr']:8.2f} dB")
        say("   z [mm]      CC    SSIM   PSNR [dB]")
        for s in metrics["slices"]:
            say(f"{s['z_mm']:9.2f} {s['cc']:7.4f} {s['ssim']:7.4f} {s['psnr']:11.2f}")
    if settings.measurement is not None:
        measurement = Measurement.read(settings.measurement)
        asked = _asked_for(settings.result)
        held_out, model = _held_out(settings, asked, measurement), str(asked.get("model", "lever_arm"))
        reprojection = reproject(field, measurement, held_out, model=model)
        reprojection.write(settings.result / REPROJECTION)
        metrics["measurement"] = str(settings.measurement.resolve())
        metrics["views"] = evaluate_views(reprojection)
        say("view                CC    SSIM  PSNR [dB]  rms [px]")
        for v in metrics["views"]:
            held = "  held out" if v["held_out"] else ""
            say(f"{v['name']:<14} {v['cc']:7.4f} {v['ssim']:7.4f} {v['psnr']:10.2f} {v['rms_px']:9.4f}{held}")
    update_json(settings.result / "metrics.json", metrics)
    return metrics


def run_over_time(settings: Evaluate) -> dict[str, Any]:
    """Compare every frame of a sequence with its truth; the metrics are kept in RESULT.metrics.json."""
    from nerif.metrics import volume_errors
    from nerif.sequence.store import DONE, SequenceStore

    if settings.truth is None or settings.measurement is not None:
        raise InputError(
            "evaluate: expected --truth NAME.truth.zarr alone for a sequence, whose views are compared already"
        )
    store, truth = SequenceStore(settings.result), VolumeSequence(settings.truth)
    if len(store) != len(truth) or any(abs(a - b) > 1e-9 for a, b in zip(store.times, truth.times, strict=True)):
        raise InputError(
            f"{settings.truth}: expected the instants of {settings.result}, {len(store)} frames, got others"
        )
    frames: list[dict[str, Any]] = []
    done = [i for i, status in enumerate(store.status) if status == DONE]
    with counting_bar("comparing frames", len(done)) as bar:
        for i in done:
            found = store.field(i).sample(truth.grid).numpy()
            errors = volume_errors(truth.volume(i, "index_excess").values.numpy(), found, store.n_ambient)
            frames.append({"frame": i, "time_s": store.times[i], **errors})
            bar(len(frames))
    if not frames:
        raise InputError(f"{settings.result}: no frame of it is done yet; run nerif sequence again")
    say("frame   t [ms]        L2  L2 variation       CC")
    for f in frames:
        say(f"{f['frame']:5d} {f['time_s'] * 1e3:8.3f} {f['l2']:9.3%} {f['l2_variation']:13.3%} {f['cc']:8.5f}")
    mean = {name: sum(f[name] for f in frames) / len(frames) for name in ("l2", "l2_variation", "cc")}
    scores = f"L2 {mean['l2']:.3%}, of variation {mean['l2_variation']:.3%}, CC {mean['cc']:.5f}"
    say(f"mean of {len(frames)} frames: {scores}")
    metrics = {"truth": str(settings.truth.resolve()), "frames": frames, "mean": mean}
    write_json(settings.result.with_suffix(".metrics.json"), metrics)
    return metrics


def _asked_for(result: Path) -> dict[str, Any]:
    """The settings of the reconstruction, where they are kept with it."""
    return read_toml(result / RUN) if (result / RUN).is_file() else {}


def _held_out(settings: Evaluate, asked: dict[str, Any], measurement: Measurement) -> tuple[str, ...]:
    """Names of the views that the reconstruction has not seen."""
    if settings.hold_out is None:
        return tuple(name for name in asked.get("hold_out", ()) if name in measurement.names)
    unknown = [name for name in settings.hold_out if name not in measurement.names]
    if unknown:
        raise InputError(f"hold_out: expected views out of {', '.join(measurement.names)}, got '{unknown[0]}'")
    return settings.hold_out


def _coverage(result: Path, truth: Volume) -> dict[str, Any]:
    """Share of the truth's voxels within two standard deviations of the mean, if there is an ensemble."""
    found = read_volumes(result / VOLUME) if (result / VOLUME).is_file() else {}
    if "index_excess_std" not in found:
        return {}

    def on_its_grid(volume: Volume) -> Tensor:
        if volume.grid == truth.grid:
            return volume.values
        return VoxelField.through(volume.values, volume.grid).sample(truth.grid)

    mean, std = (on_its_grid(found[f"index_excess_{s}"]) for s in ("mean", "std"))
    within = (truth.values - mean).abs() <= 2 * std
    flow = truth.values.abs() > FLOW * truth.values.abs().max()
    share = {"share": float(within.float().mean()), "share_in_flow": float(within[flow].float().mean())}
    say(f"truth within 2 standard deviations of the ensemble's mean: {share['share']:.1%} of the voxels,")
    say(f"  {share['share_in_flow']:.1%} of those where the excess is above {FLOW:.0%} of its largest")
    return {"coverage": share}


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Evaluate(result=tyro.MISSING), arguments, "evaluate"))
