"""nerif export: a reconstruction on any grid, a film, or the geometry of a measurement, for other programs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from nerif.cli.arguments import check_output
from nerif.cli.output import counting_bar, say
from nerif.cli.settings import Settings, command
from nerif.common.conventions import InputError
from nerif.common.files import ending
from nerif.common.settings import Flat, Natural, Positional
from nerif.physics.media import MediumChanges
from nerif.physics.medium import derive, masked_lines

if TYPE_CHECKING:
    from nerif.geometry import Box, Grid

__all__ = ["Export", "main", "run"]

VOXELS = 100  # where a result does not say how many


@dataclass(frozen=True)
class Export(Settings):
    """Write a reconstruction as .vti (ParaView), .nc, .npz, .mat, .csv or .dat (Tecplot), on any grid.

    Volumes over time become NAME.pvd (ParaView) or NAME.dat, with a file per frame in the folder NAME.
    With --format astra or tigre, write cameras and grid of a measurement as the geometry of that program.
    """

    result: Annotated[Path, Positional]
    """Result directory of nerif reconstruct, or volumes over time (.zarr); for astra and tigre a measurement (.nc)."""
    out: Path
    """Output file; format by its ending: .vti, .nc, .npz, .mat, .csv or .dat; .pvd or .dat for all frames of volumes
    over time; .txt (DaVis) for u and v of a frame, a file per plane of z; for astra and tigre .npz."""
    format: Literal["field", "astra", "tigre"] = "field"
    """What to write: the field, or cameras and grid for astra or tigre."""
    quantities: tuple[str, ...] = ()
    """Quantities to write; of an index index_excess, n and those of the medium, such as density (default: all, but
    not the temperature of a gas)."""
    frame: int | None = None
    """Frame of volumes over time, counted from 0, on their own voxels (default: all, with .pvd or .dat)."""
    second: Path | None = None
    """Result of the same flow at another wavelength, for two unknowns: with --medium plasma density and electron
    density, with --medium mixture temperature and mole fraction (docs/media.md)."""
    voxels: Natural = 0
    """Voxels along the longest edge; 0: as many as the volumes of the result."""
    shape: tuple[int, int, int] | None = None
    """Voxels along z y x, instead of --voxels."""
    lower: tuple[float, float, float] | None = None
    """Lower corner x y z of the region, mm (default: whole box)."""
    upper: tuple[float, float, float] | None = None
    """Upper corner x y z of the region, mm."""
    force: bool = False
    """Overwrite an existing file, or folder of frames or planes."""
    medium: Annotated[MediumChanges, Flat] = field(default_factory=MediumChanges)


def run(settings: Export) -> None:
    """Write the file."""
    from nerif.data.folder_export import FOLDER_FORMATS
    from nerif.data.geometry_export import export_geometry
    from nerif.data.measurement import Measurement
    from nerif.data.velocity_sequence import open_volumes
    from nerif.data.volume import FORMATS, export
    from nerif.results.directory import ResultDirectory
    from nerif.results.two_unknowns import two_unknowns

    over_time = ending(settings.result) == ".zarr"
    if settings.second is not None and (over_time or settings.format != "field" or settings.quantities):
        raise InputError("expected the field of two results, without --format and --quantities", field="second")
    endings = (*FORMATS, *(FOLDER_FORMATS if over_time else ()))
    check_output(settings.out, settings.force, endings=endings if settings.format == "field" else (".npz",))
    if settings.format != "field":
        if settings.quantities:
            raise InputError(f"expected none with --format {settings.format}, which has no field", field="quantities")
        measurement = Measurement.read(settings.result)
        grid = _grid(settings, measurement.box)
        export_geometry(settings.out, measurement, grid, settings.format, lambda line: say(f"note: {line}"))
        say(f"{settings.out}: {len(measurement.cameras)} views and {' x '.join(map(str, grid.shape))} voxels (z, y, x)")
        return
    if over_time:
        store = open_volumes(settings.result)
        with counting_bar("writing files") as bar:
            done = store.export(settings.out, settings.quantities, settings.frame, settings.force, bar)
        say(f"{done.path}: {done.summary}")
        if done.left_out:
            say(f"{done.left_out} missing or failed frames were left out")
        return
    if settings.frame is not None:
        raise InputError("expected volumes over time (.zarr) with --frame", field="frame")
    result = ResultDirectory(settings.result)
    (_, whole, _), quantity = result.field(), result.quantity()
    grid = _grid(replace(settings, voxels=settings.voxels or result.settings().get("voxels", 0)), whole)
    if settings.second is not None:
        with counting_bar("sampling the fields"):
            medium = settings.medium.of(result.settings())
            volumes = two_unknowns([result, ResultDirectory(settings.second)], grid, medium)
        export(settings.out, volumes, settings.force)
        about = ", ".join(f"{name} {value}" for name, value in volumes[0].attributes.items())
        say(f"{settings.out}: {', '.join(v.quantity for v in volumes)} ({about})")
        return
    with counting_bar("sampling the field"):
        reconstruction, medium = result.sample(grid), settings.medium.of(result.settings())
    absent = medium.absent(reconstruction)
    if settings.medium.medium and absent and not {*medium.quantities_of(reconstruction)} & {*medium.names}:
        raise InputError(f"nothing follows from the field: {next(iter(absent.values()))}", field="medium")
    for name in settings.quantities:
        if name in absent:
            raise InputError(f"{name} does not follow from the field: {absent[name]}", field="quantities")
    default = tuple(q for q in medium.available(quantity) if q not in {*absent, *medium.optional})
    volumes = [derive(reconstruction, q, medium) for q in settings.quantities or default]
    export(settings.out, volumes, settings.force)
    names = ", ".join(v.quantity for v in volumes)
    say(f"{settings.out}: {names} on {' x '.join(map(str, grid.shape))} voxels (z, y, x)")
    written = [v.quantity for v in volumes]
    unwritten = {*medium.optional} - {*written}
    remarks = [line for line in medium.remarks(reconstruction) if line.partition(":")[0] not in unwritten]
    for line in (*medium.assumed(written), *masked_lines(volumes), *remarks):
        say(line)


def _grid(settings: Export, whole: Box) -> Grid:
    """Return the grid of the settings within a box."""
    from nerif.geometry import Box, Grid

    box = Box(settings.lower or whole.lower, settings.upper or whole.upper)
    if not whole.holds(box):
        raise InputError(
            f"expected a part of the box {whole.lower} to {whole.upper} mm, got {box.lower} to {box.upper}",
            field="lower, upper",
        )
    return Grid(box, settings.shape) if settings.shape else Grid.of_resolution(box, settings.voxels or VOXELS)


main = command("export", Export, run)
