"""nerif mask: where the flow is in each view of a measurement, for the visual hull."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

from nerif.commands.output import check_file, say
from nerif.commands.settings import Settings, read_settings
from nerif.conventions import InputError
from nerif.geometry import Grid
from nerif.measurement import Measurement
from nerif.reconstruction.gauge import visual_hull

__all__ = ["Mask", "main", "run"]


@dataclass(frozen=True)
class Mask(Settings):
    """Put flow masks into a measurement: by threshold on |d| / sigma, or drawn; tells what hull they leave."""

    measurement: tyro.conf.Positional[Path]
    """Measurement to start from."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Measurement to write, NAME.nc; NAME.masks.png shows the masks."""
    drawn: Path | None = None
    """Folder with a picture VIEW.png of each view (white where the flow is); views without one keep the threshold."""
    threshold: float = 4.0
    """Flow is where |d| exceeds this many sigma."""
    sigma: float | None = None
    """Noise where the measurement has none, px."""
    smooth: float = 1.5
    """Standard deviation of a Gaussian over d / sigma before the threshold, px."""
    smallest: int = 64
    """Islands and holes of fewer pixels are removed."""
    grow: int = 3
    """Pixels added all around."""
    remove: bool = False
    """Take the masks out instead."""
    force: bool = False
    """Overwrite existing files."""


def run(settings: Mask) -> Measurement:
    """Write the measurement with its masks."""
    if settings.out.suffix != ".nc":
        raise InputError(f"out: expected a name ending in .nc, got '{settings.out.name}'")
    picture = settings.out.with_suffix(".masks.png")
    check_file(settings.out, settings.force, picture)
    measurement = Measurement.read(settings.measurement)
    if settings.remove:
        measurement = replace(measurement, flow_mask=None)
        measurement.write(settings.out)
        say(f"{settings.out}: without flow masks")
        return measurement
    masks = _masks(measurement, settings)
    measurement = replace(measurement, flow_mask=torch.from_numpy(masks))
    hull = visual_hull(measurement, Grid.of_resolution(measurement.box, 64))
    measurement.write(settings.out)
    for name, mask, camera in zip(measurement.names, masks, measurement.cameras, strict=True):
        height, width = camera.image_size
        say(f"{name:<12} flow in {mask[:height, :width].mean():.1%} of the picture")
    say(f"{settings.out}: the visual hull holds {float(hull.float().mean()):.1%} of the box")
    from nerif.report.displacement_figure import save_masks

    save_masks(picture, measurement)
    say(f"{picture}: the masks over |d|; cut off flow costs more than a mask that is too large")
    return measurement


def _masks(measurement: Measurement, settings: Mask) -> np.ndarray:
    """(view, row, column) where the flow is."""
    from nerif.imaging.masks import flow_mask, read_mask

    drawn = _drawn(measurement, settings.drawn) if settings.drawn is not None else {}
    if len(drawn) < len(measurement.names) and measurement.sigma is None and settings.sigma is None:
        raise InputError(
            f"sigma: {settings.measurement} holds no noise to measure displacements by; give --sigma in px, or --drawn "
            "masks of all views"
        )
    masks = np.zeros(measurement.displacement.shape[:3], dtype=bool)
    for i, (name, camera) in enumerate(zip(measurement.names, measurement.cameras, strict=True)):
        height, width = camera.image_size
        if name in drawn:
            masks[i, :height, :width] = read_mask(drawn[name], camera.image_size)
            continue
        d = measurement.displacement[i, :height, :width].numpy().copy()
        d[~measurement.usable[i, :height, :width].numpy()] = np.nan
        if settings.sigma is not None or measurement.sigma is None:
            sigma = np.full(d.shape, settings.sigma, dtype=np.float32)
        else:
            sigma = measurement.sigma[i, :height, :width].numpy()
        masks[i, :height, :width] = flow_mask(
            d, sigma, settings.threshold, settings.smooth, settings.smallest, settings.grow
        )
    for i, name in enumerate(measurement.names):
        if not masks[i].any():
            raise InputError(f"threshold: no flow is left in view '{name}'; give less than {settings.threshold:g}")
    return masks


def _drawn(measurement: Measurement, folder: Path) -> dict[str, Path]:
    """The pictures of masks by the names of their views."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected one with VIEW.png for each view")
    found = {p.stem: p for p in sorted(folder.iterdir()) if p.suffix in (".png", ".tif", ".tiff", ".bmp")}
    known = {name: path for name, path in found.items() if name in measurement.names}
    if not known:
        raise InputError(f"{folder}: expected pictures named as the views, {', '.join(measurement.names)}, found none")
    return known


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Mask(measurement=tyro.MISSING, out=tyro.MISSING), arguments, "mask"))
