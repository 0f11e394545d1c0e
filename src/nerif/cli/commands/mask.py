"""nerif mask: where the flow is in each view of a measurement, for the visual hull."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from nerif.cli.commands.output import check_file, counting_bar, say
from nerif.cli.commands.settings import Flat, Settings, read_settings
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.geometry import Grid
from nerif.imaging.masks import MaskSettings, drawn_masks, with_flow_masks
from nerif.reconstruction.gauge import visual_hull

__all__ = ["Mask", "main", "run"]


@dataclass(frozen=True)
class Mask(Settings):
    """Put flow masks into a measurement: by threshold on value / sigma, or drawn; tells what hull they leave.

    Where a pixel is not valid nothing is known, so flow may be there: it is inside the mask.
    """

    measurement: tyro.conf.Positional[Path]
    """Measurement to start from."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Measurement to write, NAME.nc; NAME.masks.png shows the masks."""
    drawn: Path | None = None
    """Folder with an image VIEW.png of each view (white where the flow is); views without one keep the threshold."""
    sigma: float | None = None
    """Noise where the measurement has none, in the unit of what was measured (px of displacements)."""
    remove: bool = False
    """Take the masks out instead."""
    force: bool = False
    """Overwrite existing files."""
    masks: Annotated[MaskSettings, Flat] = field(default_factory=MaskSettings)


def run(settings: Mask) -> Measurement:
    """Write the measurement with its masks."""
    if settings.out.suffix != ".nc":
        raise InputError(f"expected a name ending in .nc, got '{settings.out.name}'", field="out")
    image = settings.out.with_suffix(".masks.png")
    check_file(settings.out, settings.force, image)
    measurement = Measurement.read(settings.measurement)
    if settings.remove:
        measurement = replace(measurement, flow_mask=None)
        measurement.write(settings.out)
        say(f"{settings.out}: without flow masks")
        return measurement
    drawn = drawn_masks(settings.drawn, measurement.names) if settings.drawn is not None else {}
    with counting_bar("finding the flow", len(measurement.names)) as bar:
        sigma = settings.sigma
        measurement = with_flow_masks(measurement, settings.masks, sigma, drawn, bar)
    assert measurement.flow_mask is not None
    hull = visual_hull(measurement, Grid.of_resolution(measurement.box, 64))
    measurement.write(settings.out)
    for name, mask, camera in zip(measurement.names, measurement.flow_mask, measurement.cameras, strict=True):
        height, width = camera.image_size
        say(f"{name:<12} flow in {float(mask[:height, :width].float().mean()):.1%} of the image")
    say(f"{settings.out}: the visual hull holds {float(hull.float().mean()):.1%} of the box")
    from nerif.report.displacement_figure import save_masks

    save_masks(image, measurement)
    measured = measurement.observations[0].technique.measured
    say(f"{image}: the masks over |{measured}|; cut off flow costs more than a mask that is too large")
    return measurement


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Mask(measurement=tyro.MISSING, out=tyro.MISSING), arguments, "mask"))
