"""Two unknowns of a flow from its results at two wavelengths."""

from __future__ import annotations

from collections.abc import Sequence

from nerif.common.conventions import InputError
from nerif.data.quantity_names import INDEX
from nerif.data.volume import Volume
from nerif.geometry import Grid
from nerif.physics.media import MEDIA
from nerif.physics.medium import Medium
from nerif.physics.two_wavelengths import separate
from nerif.results.directory import ResultDirectory

__all__ = ["two_unknowns"]


def two_unknowns(results: Sequence[ResultDirectory], grid: Grid, medium: Medium) -> list[Volume]:
    """Return density and electron density of a plasma, or temperature and mole fraction of a mixture.

    Standard deviations are added on the grid of the results' volumes if those have them.

    Parameters
    ----------
    results : two, of one flow
    """
    lights = []
    for result in results:
        result.quantity()  # refuses what is no result
        entries = result.settings()
        name = str(entries.get("medium", "gas"))
        light = entries.get(name, {}).get("wavelength_nm") if name in MEDIA else None
        if light is None:
            raise InputError("expected a result whose settings have the wavelength, got none", field=result.path)
        lights.append(float(light))
    if abs(lights[0] - lights[1]) < 1:
        raise InputError(
            f"expected results at two wavelengths, got {lights[0]:g} and {lights[1]:g} nm; state that of each "
            "measurement with --wavelength-nm of nerif displacement or nerif vectors",
            field="second",
        )
    fields = [result.sample(grid) for result in results]
    stored = [result.volumes().get(f"{INDEX}_std") for result in results]
    stds = [std.values for std in stored if std is not None and std.grid == grid]
    return separate(fields, lights, medium, stds if len(stds) == len(results) else None)
