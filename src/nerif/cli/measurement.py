"""What nerif displacement and nerif vectors share: settings, and the table of the views that they print."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from nerif.cli.output import say
from nerif.cli.settings import Settings
from nerif.common.settings import Positional

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement

__all__ = ["MeasurementSettings", "print_views"]


@dataclass(frozen=True)
class MeasurementSettings(Settings):
    """Settings of commands that make a measurement of all views."""

    folder: Annotated[Path, Positional]
    calibration: Path
    """Calibrated cameras with the names of the views: output of nerif calibrate, or any file that it imports."""
    out: Path
    lower: tuple[float, float, float] | None = None
    """Lower corner x y z of the box to reconstruct, mm (default: box of the calibration)."""
    upper: tuple[float, float, float] | None = None
    """Upper corner x y z of the box, mm."""
    views: tuple[str, ...] = ()
    """Views to use (default: all)."""


def print_views(measurement: Measurement, noise: Mapping[str, str]) -> None:
    """Print displacements and noise of each view, px.

    Parameters
    ----------
    noise : source of the noise by view
    """
    from nerif.data.measurement_summary import valid_pixels
    from nerif.forward.deflection import Deflection

    say(f"{'view':<12}{'valid':>8}{'rms d [px]':>12}{'max |d| [px]':>14}{'sigma [px]':>12}  noise from")
    assert measurement.sigma is not None
    (deflection,) = (o for o in measurement.observations if o.technique is Deflection)
    usable = measurement.usable_for(deflection)
    for i, (name, share) in enumerate(zip(measurement.names, measurement.valid_share(deflection), strict=True)):
        d, sigma = measurement.displacements[i][usable[i]], measurement.sigma[i][usable[i]]
        say(
            f"{name:<12}{share:>8.1%}{float(d.square().mean().sqrt()):>12.3f}"
            f"{float(d.norm(dim=-1).max()):>14.3f}{float(sigma.median()):>12.4f}  {noise[name]}"
        )
    say(f"valid pixels: {valid_pixels(measurement)}")
