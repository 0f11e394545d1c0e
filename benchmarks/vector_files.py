"""Files of vectors as each program documents them, from a measurement whose pixels are the vectors.

The vectors are given in px of the images, u right and v down, at positions on the flow image; each writer has the
conventions of its program, written again from its source (docs/vectors.md) and not from nerif's reader.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

__all__ = ["WRITERS", "Grid", "Written", "write_session"]

MM, DT = 0.05, 2e-3  # length of a pixel and time between the images, where a program writes m/s


@dataclass(frozen=True)
class Written:
    """How a program writes."""

    first: float  #: position of its first vector, steps from the edge of the image
    lag: float  #: share of the displacement by which its position lies before that on the flow image
    write: Callable[[Path, Grid], None]
    ending: str
    arguments: tuple[str, ...] = ()  #: of nerif vectors
    digits: float = 1e-5  #: rounding of the file, px


@dataclass(frozen=True)
class Grid:
    """Vectors (row, column, 2) in px at origin + step (column, row), of an image of `height` px."""

    d: np.ndarray
    missing: np.ndarray  #: (row, column) True: flagged by the program
    origin: float
    step: int
    height: int

    def moved(self, lag: float) -> Grid:
        """Vectors at positions p of which p + lag d lies on the flow image: d0(p) = d(p + lag d0(p))."""
        rows, columns = np.mgrid[: self.d.shape[0], : self.d.shape[1]].astype(float)
        d0 = self.d
        for _ in range(20):
            place = [rows + lag * d0[..., 1] / self.step, columns + lag * d0[..., 0] / self.step]
            d0 = np.stack([map_coordinates(self.d[..., k], place, order=3, mode="nearest") for k in (0, 1)], axis=-1)
        return Grid(d0, self.missing, self.origin, self.step, self.height)

    @property
    def xy(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (row, column), px, from 0."""
        rows, columns = np.mgrid[: self.d.shape[0], : self.d.shape[1]]
        return self.origin + self.step * columns, self.origin + self.step * rows


def _cells(frames: list[np.ndarray]) -> np.ndarray:
    cells = np.empty((len(frames), 1), dtype=object)
    for i, frame in enumerate(frames):
        cells[i, 0] = frame
    return cells


def pivlab_export(path: Path, grid: Grid) -> None:
    """+export/mat_file_save.m, one frame: matrices, y down, the first pixel at 1.5, masked values not NaN."""
    from scipy.io import savemat

    x, y = (a + 1.5 for a in grid.xy)
    kind = np.where(grid.missing, 0, 1)
    u, v = (np.where(grid.missing, 7.0, grid.d[..., k]).astype(np.float32) for k in (0, 1))
    empty = np.empty((0, 0))
    savemat(path, {
        "x": x, "y": y, "u_original": u + 1, "v_original": v, "typevector_original": kind, "u_filtered": u,
        "v_filtered": v, "typevector_filtered": kind, "u_smoothed": empty, "v_smoothed": empty, "calxy": 1.0,
        "calu": 1.0, "calv": 1.0, "units": "[px] respectively [px/frame]",
    })  # fmt: skip


def pivlab_metres(path: Path, grid: Grid) -> None:
    """The same after a calibration with y up: metres, m/s, calv negative, cells of one frame."""
    from scipy.io import savemat

    x, y = grid.xy
    calxy = MM / 1e3
    kind = np.where(grid.missing, 2, 1)
    u, v = (np.where(grid.missing, np.nan, grid.d[..., k] * calxy / DT) for k in (0, 1))
    empty = np.empty((0, 0))
    content = {
        "x": (x + 1.5) * calxy, "y": (grid.height - (y + 1.5)) * calxy, "u_original": u, "v_original": -v,
        "typevector_original": kind, "u_filtered": empty, "v_filtered": empty, "typevector_filtered": empty,
    }  # fmt: skip
    cells = {name: _cells([value]) for name, value in content.items()}
    savemat(path, cells | {"calxy": calxy, "calu": calxy / DT, "calv": -calxy / DT, "units": "[m] respectively [m/s]"})


def write_session(path: Path, grids: list[Grid], version: str = "5") -> None:
    """+export/save_session_function.m: resultslist {row, frame}, raw pixels; version 7.3 is HDF5, axes reversed."""
    rows: list[list[np.ndarray]] = []
    for grid in grids:
        x, y = (a + 1.5 for a in grid.xy)
        kind = np.where(grid.missing, 0, 1).astype(float)
        u, v = grid.d[..., 0], grid.d[..., 1]
        empty = np.empty((0, 0))
        rows.append([x, y, u + 2, v, kind, empty, u, v, kind, empty, empty, empty])
    if version == "5":
        from scipy.io import savemat

        cells = np.empty((12, len(grids)), dtype=object)
        for j, frame in enumerate(rows):
            for i, value in enumerate(frame):
                cells[i, j] = value
        savemat(path, {"resultslist": cells, "calxy": 5e-5, "calu": 0.1})
        return
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        store = file.create_group("#refs#")
        table = file.create_dataset("resultslist", (len(rows), 12), dtype=h5py.ref_dtype)
        table.attrs["MATLAB_class"] = np.bytes_("cell")
        for j, frame in enumerate(rows):
            for i, value in enumerate(frame):
                data = value.T if value.size else np.zeros(2, dtype=np.uint64)
                item = store.create_dataset(f"v{j}_{i}", data=data)
                item.attrs["MATLAB_class"] = np.bytes_("double")
                if not value.size:
                    item.attrs["MATLAB_empty"] = np.uint8(1)
                table[j, i] = item.ref
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124, b" ") + b"\x00\x02IM")


def pivlab_ascii(path: Path, grid: Grid, metres: bool = False) -> None:
    """+export/file_save.m: y fastest, CRLF, NaN and vector type 0; in metres after a calibration with y up."""
    (x, y), d = (a + 1.5 for a in grid.xy), grid.d
    xy, uv, units = 1.0, 1.0, "x [px],y [px],u [px/frame],v [px/frame]"
    if metres:
        xy, uv, units = MM / 1e3, MM / 1e3 / DT, "x [m],y [m],u [m/s],v [m/s]"
        x, y, d = xy * x, xy * (grid.height - y), uv * d * (1, -1)
    lines = [
        "PIVlab, ASCII chart output - 07-Oct-2026",
        f"FRAME: 1, filenames: A: a.tif & B: b.tif, conversion factor xy (px -> m): {xy:.10g}, "
        f"conversion factor uv (px/frame -> m/s): {uv:.10g}",
        f"{units},Vector type [-]",
    ]
    for j in range(x.shape[1]):
        for i in range(x.shape[0]):
            u, v = ("NaN", "NaN") if grid.missing[i, j] else (f"{d[i, j, 0]:.10g}", f"{d[i, j, 1]:.10g}")
            lines.append(f"{x[i, j]:.10g},{y[i, j]:.10g},{u},{v},{0 if grid.missing[i, j] else 1}")
    path.write_bytes("\r\n".join([*lines, ""]).encode())


def openpiv(path: Path, grid: Grid) -> None:
    """openpiv/tools.py: save() after transform_coordinates: rows from the top, y mirrored on the grid, v up, %.4e."""
    x, y = (a + 0.5 for a in grid.xy)
    u, v = grid.d[..., 0].copy(), -grid.d[..., 1]
    u[grid.missing] = np.nan
    table = [x, y[::-1], u, v, grid.missing, 0 * x]
    np.savetxt(path, np.stack([a.ravel() for a in table], axis=-1), fmt="%.4e", delimiter="\t",
               header="x\ty\tu\tv\tflags\tmask")  # fmt: skip


def openpiv_old(path: Path, grid: Grid) -> None:
    """The same of 2019 without head: x y u v mask s2n, as openpiv_tk_gui writes them; not transformed."""
    x, y = (a + 0.5 for a in grid.xy)
    table = [x, y, grid.d[..., 0], grid.d[..., 1], grid.missing, 1.3 + 0 * x]
    np.savetxt(path, np.stack([a.ravel() for a in table], axis=-1), fmt="%8.4f", delimiter="\t")


def davis_buffer(path: Path, grid: Grid) -> None:
    """lvpyio.write_buffer: components in px, v down, scales of a calibrated image with y up."""
    from lvpyio import Component, Scale, Scales, write_buffer
    from lvpyio import Grid as Spacing
    from lvpyio.types.buffer import Buffer
    from lvpyio.types.component import Components
    from lvpyio.types.frame import VectorFrame

    u, v = (np.where(grid.missing, 0, grid.d[..., k]).astype(np.float32) for k in (0, 1))
    there = (~grid.missing).astype(np.uint8)
    velocity = Scale(MM / 1e3 / DT, 0.0, "m/s", "velocity")
    parts = {
        "U0": u,
        "V0": v,
        "MASK": there,
        "ENABLED": np.ones_like(there),
        "ACTIVE_CHOICE": np.zeros(u.shape, np.int32),
    }
    components = Components(
        {name: Component(velocity if name in ("U0", "V0") else Scale(), [a]) for name, a in parts.items()}
    )
    scales = Scales(Scale(MM, -3.0, "mm"), Scale(-MM, 9.0, "mm"), Scale(), velocity)
    frame = VectorFrame(components, scales, {"FrameDt": "2000 µs"}, Spacing(grid.step, grid.step, 1), 1)
    write_buffer(Buffer([frame], {}), str(path))


def davis_text(path: Path, grid: Grid) -> None:
    """DaVis 8: .txt with decimal commas, mm with the origin in the middle, y up, m/s; masked vectors are 0 -0."""
    x, y = grid.xy
    rows, columns = x.shape
    factor = MM / 1e3 / DT
    lines = [f'#DaVis 8.1.6 2D-vector {grid.step} {rows} {columns} "position" "mm" "position" "mm" "velocity" "m/s"']
    for i in range(rows):
        for j in range(columns):
            u, v = (
                ("0", "-0")
                if grid.missing[i, j]
                else (f"{grid.d[i, j, 0] * factor:.6g}", f"{-grid.d[i, j, 1] * factor:.6g}")
            )
            place = f"{(x[i, j] + 0.5) * MM - 3:.6g}\t{9 - (y[i, j] + 0.5) * MM:.6g}"
            lines.append(f"{place}\t{u}\t{v}".replace(".", ","))
    path.write_bytes("\r\n".join([*lines, ""]).encode())


def davis_tecplot(path: Path, grid: Grid) -> None:
    """DaVis 10: Tecplot .dat, mm with the origin at the lower left corner, y falling, isValid 1."""
    x, y = grid.xy
    lines = [
        'TITLE = "B00001"', 'VARIABLES = "x [mm]", "y [mm]", "Velocity u [m/s]", "Velocity v [m/s]", "isValid"',
        f'ZONE T="Frame 0", I={x.shape[1]}, J={x.shape[0]}, F=POINT', "STRANDID=1, SOLUTIONTIME=0.4",
    ]  # fmt: skip
    factor = MM / 1e3 / DT
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            u, v = grid.d[i, j] * (factor, -factor) * (not grid.missing[i, j])
            place = f"{(x[i, j] + 0.5) * MM:.6g} {(grid.height - 0.5 - y[i, j]) * MM:.6g}"
            lines.append(f"{place} {u:.7g} {v:.7g} {0 if grid.missing[i, j] else 1}")
    path.write_text("\n".join([*lines, ""]))


def insight(path: Path, grid: Grid) -> None:
    """TSI Insight .vec: one line of head with scale and time, y from 0 at the upper edge downwards negative, CHC."""
    x, y = grid.xy
    head = (
        'TITLE="b.vec" VARIABLES="X mm", "Y mm", "U m/s", "V m/s", "CHC", DATASETAUXDATA Application="PIV" '
        f'DATASETAUXDATA MicrometersPerPixelX="{1e3 * MM:.6f}" DATASETAUXDATA MicrosecondsPerDeltaT="{1e6 * DT:.6f}" '
        f"ZONE I={x.shape[1]}, J={x.shape[0]}, F=POINT"
    )
    factor = MM / 1e3 / DT
    lines = [head]
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            u, v = grid.d[i, j] * (factor, -factor)
            place = f"{(x[i, j] + 0.5) * MM:.6f}, {-(y[i, j] + 0.5) * MM:.6f}"
            lines.append(f"{place}, {u:.7f}, {v:.7f}, {-1 if grid.missing[i, j] else 1}")
    path.write_text("\n".join([*lines, ""]))


def dantec(path: Path, grid: Grid) -> None:
    """Dynamic Studio: head, indices, px and mm, rows from the bottom, y and v up, Status 0."""
    x, y = grid.xy
    lines = [
        ">>*HEADER*<<", "FileID:DSExport.CSV", "Version:2", f"GridSize:{{Width={x.shape[1]}, Height={x.shape[0]}}}",
        "TimeStamp:#1, 0.0133 s", ">>*DATA*<<",
        "x,y,x (pix)[pix],y (pix)[pix],x (mm)[mm],y (mm)[mm],U pix[pix],V pix[pix],U[m/s],V[m/s],Length[m/s],Status",
    ]  # fmt: skip
    factor = MM / 1e3 / DT
    for row in range(x.shape[0]):
        i = x.shape[0] - 1 - row
        for j in range(x.shape[1]):
            u, v = grid.d[i, j] * (1, -1)
            px, py = x[i, j] + 0.5, grid.height - 0.5 - y[i, j]
            cells = [j, row, px, py, px * MM, py * MM, u, v, u * factor, v * factor, np.hypot(u, v) * factor]
            lines.append(",".join(f"{c:.8g}" for c in cells) + f",{17 if grid.missing[i, j] else 0}")
    path.write_text("\n".join([*lines, ""]))


def table(path: Path, grid: Grid) -> None:
    """A table with names, semicolons and decimal commas, in any order of rows."""
    x, y = grid.xy
    order = np.random.default_rng(0).permutation(x.size)
    lines = ["v;u;y;x;flag"]
    for k in order:
        i, j = divmod(int(k), x.shape[1])
        lines.append(
            f"{grid.d[i, j, 1]:.8g};{grid.d[i, j, 0]:.8g};{y[i, j]};{x[i, j]};{int(grid.missing[i, j])}".replace(
                ".", ","
            )
        )
    path.write_bytes("\r\n".join([*lines, ""]).encode("utf-16"))


def arrays(path: Path, grid: Grid) -> None:
    """NumPy arrays."""
    x, y = grid.xy
    u = np.where(grid.missing, np.nan, grid.d[..., 0])
    np.savez(path, x=x[0], y=y[:, 0], u=u, v=grid.d[..., 1])


M_S = ("--scale", str(MM), "--time-step", str(DT))
WRITERS = {
    "PIVlab export": Written(1.0, 1.0, pivlab_export, ".mat"),
    "PIVlab export in m/s": Written(1.0, 1.0, pivlab_metres, ".mat"),
    "PIVlab session": Written(1.0, 1.0, lambda p, g: write_session(p, [g]), ".mat"),
    "PIVlab session 7.3": Written(1.0, 1.0, lambda p, g: write_session(p, [g], "7.3"), ".mat"),
    "PIVlab text": Written(1.0, 1.0, pivlab_ascii, ".txt"),
    "PIVlab text in m/s": Written(1.0, 1.0, lambda p, g: pivlab_ascii(p, g, metres=True), ".txt"),
    "OpenPIV": Written(1.0, 0.5, openpiv, ".txt", digits=1e-3),
    "OpenPIV 2019": Written(1.0, 0.5, openpiv_old, ".txt", digits=1e-4),
    "DaVis .vc7": Written(0.5, 0.5, davis_buffer, ".vc7"),
    "DaVis text": Written(0.5, 0.5, davis_text, ".txt", ("--time-step", str(DT))),
    "DaVis Tecplot": Written(1.0, 0.5, davis_tecplot, ".dat", M_S),
    "Insight": Written(1.0, 0.5, insight, ".vec", digits=1e-3),
    "Dynamic Studio": Written(1.0, 0.5, dantec, ".csv"),
    "a table": Written(1.0, 0.0, table, ".csv"),
    "arrays": Written(1.0, 0.0, arrays, ".npz"),
}
"""Files by the name of their program. Windows of DaVis reach over the edge of the image."""
