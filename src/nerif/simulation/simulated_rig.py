"""The cameras of simulated data."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from nerif.common.conventions import InputError
from nerif.common.settings import Checked, Flat, NonNegative
from nerif.geometry.rig import Ring

if TYPE_CHECKING:
    from nerif.geometry.camera import Camera

__all__ = ["SimulatedRig"]


@dataclass(frozen=True)
class SimulatedRig(Checked):
    """A ring of cameras, or those of a calibration."""

    calibration: Path | None = None
    """Calibration whose cameras are simulated, with their lenses and windows, instead of a ring."""
    f_number: NonNegative = 0.0
    """f-number of the lenses of a ring, focused on the backgrounds (0: thin rays)."""
    ring: Annotated[Ring, Flat] = field(default_factory=Ring)

    def cameras(self) -> tuple[Camera, ...]:
        """Return the cameras."""
        if self.calibration is None:
            return self.ring.cameras(self.f_number)
        from nerif.imaging.calibration.importers.importers import import_cameras

        changed = [name for name, value in vars(self.ring).items() if value != getattr(Ring(), name)]
        if changed := changed + ["f_number"] * bool(self.f_number):
            names = ", ".join(f"--{name.replace('_', '-')}" for name in changed)
            raise InputError(f"expected without {names}, which the file replaces", field="calibration")
        return tuple(camera.camera() for camera in import_cameras(self.calibration))
