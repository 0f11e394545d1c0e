"""nerif project: what any camera would see of a reconstruction."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nerif.analysis.prediction import predict
from nerif.cli.commands.output import check_file, counting_bar, say
from nerif.cli.commands.settings import Flat, Settings, read_settings
from nerif.common.conventions import InputError, with_unit
from nerif.data.measurement import Measurement
from nerif.forward.registry import AUTO, model_of, technique, technique_of
from nerif.geometry import Ring
from nerif.reconstruction.aperture import seen_through
from nerif.results.directory import ResultDirectory

__all__ = ["Project", "main", "run"]


@dataclass(frozen=True)
class Project(Settings):
    """Predict what cameras would see of a reconstruction, and write it as a measurement."""

    result: Annotated[Path, tyro.conf.Positional]
    """Result directory of nerif reconstruct."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Measurement to write, NAME.nc."""
    cameras: Path | None = None
    """Measurement file whose cameras to use; without it, the ring described below."""
    names: tuple[str, ...] = ()
    """Names of the cameras of that file to use; none for all."""
    f_number: float = 0.0
    """Focal length over aperture of the ring's lenses, focused on the backgrounds; 0 for thin rays."""
    aperture: str = "auto"
    """Cameras of a file see through the whole of their lens where its aperture is known (auto, or on to insist), or by
    thin rays (off)."""
    model: str | None = None
    """Forward model: lever_arm, paraxial, curved, or traced (Runge-Kutta); default: that of the reconstruction,
    where the technique has it."""
    technique: str | None = None
    """What a pixel measures: deflection, absorption, emission, interferometry; default: the first of such a field."""
    wavelength_nm: float | None = None
    """Wavelength of the light, nm, for interferometry; default: that of the file with the cameras."""
    samples: int = 200
    """Samples (or Runge-Kutta steps) along a ray."""
    force: bool = False
    """Overwrite an existing file."""
    ring: Annotated[Ring, Flat] = field(default_factory=Ring)


def run(settings: Project) -> Measurement:
    """Write the predicted measurement and return it."""
    if settings.out.suffix != ".nc":
        raise InputError(f"expected a name ending in .nc, got '{settings.out.name}'", field="out")
    check_file(settings.out, settings.force)
    result = ResultDirectory(settings.result)
    index, box, n_ambient = result.field()
    wavelength = settings.wavelength_nm
    if settings.cameras is not None and settings.f_number:
        raise InputError(
            "expected for the ring, got cameras of a file, which know their own aperture", field="f_number"
        )
    if settings.cameras is None and settings.aperture != "auto":
        raise InputError(
            "expected together with --cameras FILE, got no file; the ring takes --f-number", field="aperture"
        )
    if settings.cameras is not None:
        given = seen_through(Measurement.read(settings.cameras), settings.aperture)
        wavelength = wavelength or given.wavelength_nm
        cameras = (given.select(settings.names) if settings.names else given).cameras
    elif settings.names:
        raise InputError("expected together with --cameras FILE, got no file", field="names")
    else:
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
        of = " a component" if len(kind.channels) > 1 else ""
        say(f"{camera.name}: rms {kind.measured} {with_unit(f'{rms:.4g}', kind.unit)}{of}")
    say(f"{settings.out}: {len(cameras)} predicted views ({model})")
    return predicted


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Project(tyro.MISSING, tyro.MISSING), arguments, "project"))
