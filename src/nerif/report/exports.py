"""Files for other programs: VTK image data (.vti, opens in ParaView) and comma-separated text."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from nerif.conventions import InputError
from nerif.volume import Volume, write_netcdf
from nerif.vti import write_vti

__all__ = ["export", "write_csv"]


def export(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    """Write volumes on one grid to `path`, by its ending: .vti, .nc or .csv."""
    writers = {".vti": _write_vti, ".nc": write_netcdf, ".csv": write_csv}
    suffix = Path(path).suffix
    if suffix not in writers:
        raise InputError(f"{path}: expected a name ending in {', '.join(writers)}, got '{suffix}'")
    writers[suffix](path, volumes)


def _write_vti(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    write_vti(path, {v.quantity: v.values for v in volumes}, volumes[0].grid, volumes[0].attributes)


def write_csv(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    """Write one line a voxel: x, y, z in mm, then each quantity with its unit in the header."""
    import numpy as np

    points = volumes[0].grid.points(torch.float64).reshape(-1, 3)
    columns = [points, *(v.values.cpu().double().reshape(-1, 1) for v in volumes)]
    header = ",".join(["x_mm", "y_mm", "z_mm", *(f"{v.quantity} [{v.unit}]" for v in volumes)])
    temporary = Path(f"{os.fspath(path)}.part")
    np.savetxt(temporary, torch.cat(columns, dim=1).numpy(), delimiter=",", header=header, comments="", fmt="%.9g")
    os.replace(temporary, path)
