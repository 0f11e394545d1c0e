"""nerif mask: the flow region in each view of a measurement, for the visual hull."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from nerif.cli.arguments import check_output
from nerif.cli.output import counting_bar, say
from nerif.cli.settings import Settings, command
from nerif.common.settings import Flat, Positional
from nerif.imaging.imaging_settings import MaskSettings

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement

__all__ = ["Mask", "main", "run"]


@dataclass(frozen=True)
class Mask(Settings):
    """Add flow masks to a measurement, by a threshold on value / sigma or from drawings, and report the visual hull.

    Pixels without valid data are inside the mask, since flow may be there.
    """

    measurement: Annotated[Path, Positional]
    """Measurement file."""
    out: Path
    """Measurement to write, NAME.nc, with a figure NAME.masks.png."""
    drawings: Path | None = None
    """Folder with an image VIEW.png per view (white: flow); views without one use the threshold."""
    sigma: float | None = None
    """Noise of a measurement without sigma, in the unit of its values (px for displacements)."""
    remove: bool = False
    """Remove the masks."""
    force: bool = False
    """Overwrite existing files."""
    masks: Annotated[MaskSettings, Flat] = field(default_factory=MaskSettings)


def run(settings: Mask) -> Measurement:
    """Write the measurement with its masks."""
    from nerif.data.measurement import Measurement
    from nerif.geometry import Grid
    from nerif.imaging.masks import drawn_masks, with_flow_masks
    from nerif.reconstruction.gauge import visual_hull

    image = settings.out.with_suffix(".masks.png")
    check_output(settings.out, settings.force, image, endings=(".nc",))
    measurement = Measurement.read(settings.measurement)
    if settings.remove:
        measurement = replace(measurement, flow_mask=None)
        measurement.write(settings.out)
        say(f"{settings.out}: without flow masks")
        return measurement
    drawings = {} if settings.drawings is None else drawn_masks(settings.drawings, measurement.names, say)
    with counting_bar("masking the flow", len(measurement.names)) as bar:
        measurement = with_flow_masks(measurement, settings.masks, settings.sigma, drawings, bar, say)
    assert measurement.flow_mask is not None
    hull = visual_hull(measurement, Grid.of_resolution(measurement.box, 64))
    measurement.write(settings.out)
    for name, mask, camera in zip(measurement.names, measurement.flow_mask, measurement.cameras, strict=True):
        height, width = camera.image_size
        say(f"{name:<12} flow in {float(mask[:height, :width].float().mean()):.1%} of the image")
    say(f"{settings.out}: the visual hull fills {float(hull.float().mean()):.1%} of the box")
    from nerif.report.displacement_figure import save_masks

    save_masks(image, measurement, measurement.flow_mask)
    values = measurement.observations[0].technique.measured
    say(f"{image}: the masks over |{values}|; a mask that is too small costs more than one that is too large")
    return measurement


main = command("mask", Mask, run)
