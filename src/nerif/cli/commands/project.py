"""nerif project: predicted measurements of a reconstruction by any camera."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from nerif.cli.arguments import check_output
from nerif.cli.output import counting_bar, say
from nerif.cli.settings import Settings, command
from nerif.common.conventions import InputError, with_unit
from nerif.common.settings import Flat, Positional
from nerif.forward.model_names import AUTO
from nerif.geometry.rig import Ring
from nerif.reconstruction.shared_settings import Aperture

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement

__all__ = ["Project", "main", "run"]


@dataclass(frozen=True)
class Project(Settings):
    """Predict the measurement of a reconstruction by given cameras, and write it."""

    result: Annotated[Path, Positional]
    """Result directory of nerif reconstruct."""
    out: Path
    """Measurement to write, NAME.nc."""
    cameras: Path | None = None
    """Measurement file with the cameras (default: the ring of cameras below)."""
    names: tuple[str, ...] = ()
    """Cameras of that file to use (default: all)."""
    f_number: float = 0.0
    """f-number of the lenses of the ring, focused on the backgrounds (0: thin rays)."""
    aperture: Aperture = "auto"
    """Finite aperture of the cameras of a file where it is stated (auto; on: required), or thin rays (off)."""
    model: str | None = None
    """Forward model: lever_arm, paraxial, curved or traced (Runge-Kutta) (default: as in the reconstruction)."""
    technique: str | None = None
    """Technique: deflection, absorption, emission or interferometry (default: the first that sees the field)."""
    wavelength_nm: float | None = None
    """Wavelength of the light for interferometry, nm (default: that of the file with the cameras)."""
    samples: int = 200
    """Samples, or Runge-Kutta steps, along a ray."""
    force: bool = False
    """Overwrite an existing file."""
    ring: Annotated[Ring, Flat] = field(default_factory=Ring)


def run(settings: Project) -> Measurement:
    """Write the predicted measurement and return it."""
    from nerif.analysis.prediction import predict
    from nerif.data.measurement import Measurement
    from nerif.forward.registry import model_of, technique, technique_of
    from nerif.reconstruction.aperture import apply_aperture
    from nerif.results.directory import ResultDirectory

    check_output(settings.out, settings.force, endings=(".nc",))
    result = ResultDirectory(settings.result)
    index, box, n_ambient = result.field()
    wavelength = settings.wavelength_nm
    if settings.cameras is not None:
        if settings.f_number:
            raise InputError("expected 0 with --cameras FILE, which has the apertures", field="f_number")
        source = apply_aperture(Measurement.read(settings.cameras), settings.aperture)
        wavelength = wavelength or source.wavelength_nm
        cameras = (source.select(settings.names) if settings.names else source).cameras
    else:
        for name in ("names", "aperture"):
            if getattr(settings, name) != getattr(Project, name):
                raise InputError("expected together with --cameras FILE, got no file", field=name)
        cameras = settings.ring.cameras(settings.f_number)
    kind = technique(settings.technique) if settings.technique else technique_of(result.quantity())
    model = settings.model or model_of(kind, str(result.settings().get("model", AUTO)))
    with counting_bar("projecting") as bar:
        predicted = predict(
            index, cameras, box, n_ambient, model, settings.samples, bar, kind, wavelength, result.quantity()
        )  # fmt: skip
    predicted.write(settings.out)
    for camera, values in zip(cameras, predicted.observations[0].values, strict=True):
        rms = float(values.nan_to_num().square().mean().sqrt())
        component = " per component" if len(kind.channels) > 1 else ""
        say(f"{camera.name}: rms {kind.measured} {with_unit(f'{rms:.4g}', kind.unit)}{component}")
    say(f"{settings.out}: {len(cameras)} predicted views ({model})")
    return predicted


main = command("project", Project, run)
