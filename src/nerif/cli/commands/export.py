"""nerif export: a reconstruction on any grid, for other programs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nerif.cli.commands.output import check_file, counting_bar, say
from nerif.cli.commands.settings import Settings, read_settings
from nerif.common.conventions import InputError
from nerif.data.exports import FORMATS, export
from nerif.data.volume import Volume, quantities_of
from nerif.geometry import Box, Grid
from nerif.physics.quantities import GasChanges, derive, masked_lines
from nerif.results.directory import ResultDirectory

__all__ = ["Export", "main", "run"]


@dataclass(frozen=True)
class Export(Settings):
    """Write a reconstruction as .vti (opens in ParaView), .nc, .npz, .mat or .csv, on any grid."""

    result: Annotated[Path, tyro.conf.Positional]
    """Result directory of nerif reconstruct."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """File to write; its ending says the format: .vti, .nc, .npz, .mat or .csv."""
    quantities: tuple[str, ...] = ()
    """Of an index out of index_excess (1), n (1), density (kg/m3), temperature (K); default: all but the last, or the
    field where it is no index."""
    voxels: int = 100
    """Voxels along the longest edge; near-cubic voxels."""
    shape: tuple[int, int, int] | None = None
    """Voxels along z y x, instead of --voxels."""
    lower: tuple[float, float, float] | None = None
    """Lower corner x y z of the part to write, mm; default: the whole box."""
    upper: tuple[float, float, float] | None = None
    """Upper corner x y z, mm."""
    force: bool = False
    """Overwrite an existing file."""
    gas: GasChanges = field(default_factory=GasChanges)
    """What density and temperature are computed for."""


def run(settings: Export) -> None:
    """Write the file."""
    if settings.out.suffix not in FORMATS:
        raise InputError(f"expected a name ending in {', '.join(FORMATS)}, got '{settings.out.name}'", field="out")
    check_file(settings.out, settings.force)
    result = ResultDirectory(settings.result)
    (field, whole, n_ambient), quantity = result.field(), result.quantity()
    box = Box(settings.lower or whole.lower, settings.upper or whole.upper)
    if not whole.holds(box):
        whole_box = f"{whole.lower} to {whole.upper} mm"
        raise InputError(
            f"expected a part of the box {whole_box}, got {box.lower} to {box.upper}", field="lower, upper"
        )
    grid = Grid(box, settings.shape) if settings.shape else Grid.of_resolution(box, settings.voxels)
    asked = settings.quantities or tuple(q for q in quantities_of(quantity) if q != "temperature")
    with counting_bar("sampling the field"):
        reconstructed = Volume.of(field.sample(grid), grid, quantity, n_ambient)
        gas = settings.gas.of(result.settings())
        volumes = [derive(reconstructed, q, gas) for q in asked]
        export(settings.out, volumes)
    say(f"{settings.out}: {', '.join(asked)} on {' x '.join(map(str, grid.shape))} voxels (z, y, x)")
    for line in masked_lines(volumes):
        say(line)


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Export(tyro.MISSING, tyro.MISSING), arguments, "export"))
