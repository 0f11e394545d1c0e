"""Movies of a sequence of volumes, rendered off-screen: an isosurface or slices, with box, time and colour bar."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nerif.common.arrays import filled
from nerif.common.conventions import InputError
from nerif.common.files import atomic, ending
from nerif.common.installation import install
from nerif.data.quantity_names import field_of
from nerif.data.velocity_sequence import VelocitySequence
from nerif.data.volume import Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.plotting.drawing import LABELS, colour_range, colours_of, plotted_values
from nerif.report.isosurface import default_level
from nerif.report.movie_settings import MovieSettings

__all__ = ["Movie", "finished_frames", "ranges_over_time"]

FORMATS = (".mp4", ".gif")
MASKED, GREY, VECTORS = "masked", "#BEBEBE", "velocity"
ARROWS, STREAMLINES = 20, 250  # along the longest edge; in all
SLOW = 0.03  # of the largest speed, below which an arrow is a dot


class Movie(MovieSettings):
    """A movie of a sequence of volumes."""

    def quantity_of(self, store: VolumeSequence) -> str:
        """Return the quantity that is drawn of a store."""
        names = store.quantities
        default = next((name for name in ("density", "speed") if name in names), field_of(names))
        quantity = self.quantity or default
        if quantity is None or quantity not in store.quantities:
            raise InputError(
                f"expected one of {', '.join(store.quantities)}, got '{quantity or 'none'}'", field="quantity"
            )
        return quantity

    def images(self, store: VolumeSequence, frames: Sequence[int]) -> Iterator[np.ndarray]:
        """Draw the frames, (row, column, 3) of 8 bit, on one colour scale."""
        quantity = self.quantity_of(store)
        limits, level = ranges_over_time(store, quantity, frames)
        level = level if self.level is None else self.level
        for i, time in zip(frames, instants([store.times[i] for i in frames]), strict=True):
            vectors = store.vectors(i).numpy() if isinstance(store, VelocitySequence) else None
            yield self._image(store.volume(i, quantity), f"t = {time}", limits, level, vectors)

    def _image(
        self, volume: Volume, text: str, limits: tuple[float, float], level: float, vectors: np.ndarray | None = None
    ) -> np.ndarray:
        import pyvista as pv
        from vtkmodules.vtkCommonCore import vtkLogger

        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)  # VTK warns that there is no display
        label, unit = _plain(volume.quantity)
        name = f"{label} [{unit}]"
        grid = _points(volume, name)
        plotter = pv.Plotter(off_screen=True, window_size=list(self.size))
        try:
            plotter.set_background("white")
            bar = {"title": name, "color": "black", "vertical": True, "fmt": "%.2g", "n_labels": 4}
            bar |= {"position_x": 0.86, "position_y": 0.15, "width": 0.06, "height": 0.5}
            if self.style != "isosurface":
                x, y, z = volume.grid.box.centre
                if sliced := vectors is None or self.style == "slices":
                    mesh = grid.slice_orthogonal(x=x, y=y, z=z)
                else:
                    mesh = _arrows(grid, vectors) if self.style == "arrows" else _streamlines(grid, vectors)
                if sliced or mesh.n_points:
                    plotter.add_mesh(
                        mesh, scalars=name, clim=limits, cmap=colours_of(volume.quantity),
                        scalar_bar_args=bar, lighting=False, nan_color=GREY,
                    )  # fmt: skip
            else:
                surface, masked = _surfaces(grid, name, level)
                if surface.n_points:
                    plotter.add_mesh(surface, color="#E69F00", smooth_shading=True, ambient=0.25)
                    plotter.add_text(f"{label} = {level:.4g} {'' if unit == '1' else unit}", **_text("lower_left"))
                if masked.n_points:
                    plotter.add_mesh(masked, color=GREY, opacity=0.35)
            if grid[MASKED].any():
                plotter.add_text("grey: masked", **_text("lower_right"))
            bounds = [end for pair in zip(volume.grid.box.lower, volume.grid.box.upper, strict=True) for end in pair]
            plotter.add_mesh(pv.Box(bounds=bounds), style="wireframe", color="black", line_width=1)
            plotter.show_bounds(
                bounds=bounds, xtitle="x [mm]", ytitle="y [mm]", ztitle="z [mm]", color="black", font_size=10,
                location="outer", ticks="outside",
            )  # fmt: skip
            plotter.add_text(text, **_text("upper_left"))
            plotter.camera.focal_point = volume.grid.box.centre
            plotter.camera.position = self._viewpoint(volume)
            plotter.camera.up = (0.0, 0.0, 1.0)
            return np.ascontiguousarray(plotter.screenshot(return_img=True)[..., :3])
        finally:
            plotter.close()

    def _viewpoint(self, volume: Volume) -> tuple[float, float, float]:
        azimuth, elevation = np.radians(self.azimuth), np.radians(self.elevation)
        level = np.cos(elevation)
        direction = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        x, y, z = np.array(volume.grid.box.centre) + 2.05 * float(np.linalg.norm(volume.grid.box.edges)) * direction
        return float(x), float(y), float(z)

    def write(
        self, path: Path, store: VolumeSequence, frames: Sequence[int],
        on_frame: Callable[[int], None] = lambda done: None,
    ) -> None:  # fmt: skip
        """Write the movie, atomically.

        Parameters
        ----------
        path : .mp4 (H.264) or .gif
        frames : available frames of the store
        on_frame : called with the number of finished frames
        """
        if ending(path) not in FORMATS:
            raise InputError(f"expected a name ending in {' or '.join(FORMATS)}, got '{path.name}'", field="out")
        if not len(frames):
            raise InputError("expected at least one finished frame, got none", field=store.path)
        self.quantity_of(store)
        if self.style in ("arrows", "streamlines") and not isinstance(store, VelocitySequence):
            raise InputError(f"expected isosurface or slices for volumes, got {self.style}", field="style")
        with atomic(path) as part, _writer(part, self.frames_per_second) as writer:
            for done, image in enumerate(self.images(store, frames), start=1):
                writer.append_data(image)
                on_frame(done)


def instants(times: Sequence[float]) -> list[str]:
    """Return times (s) in ms, with at least three decimals, and as many as resolve their shortest interval."""
    steps = np.diff(np.unique(times)) * 1e3
    decimals = max(3, 1 - int(np.floor(np.log10(steps.min())))) if len(steps) else 3
    return [f"{time * 1e3:.{decimals}f} ms" for time in times]


def ranges_over_time(
    store: VolumeSequence, quantity: str, frames: Sequence[int]
) -> tuple[tuple[float, float], float]:  # fmt: skip
    """Return colour range and isosurface level for all frames, from a sample of about eight."""
    sample = [store.volume(i, quantity) for i in frames[:: max(1, len(frames) // 8)]]
    ends = [colour_range(plotted_values(v)) for v in sample]
    limits = min(low for low, _ in ends), max(high for _, high in ends)
    return limits, float(np.median([default_level(v) for v in sample]))


def finished_frames(store: VolumeSequence) -> list[int]:
    """Return the available frames: all of a store without status, else the finished ones."""
    if "status" not in store.group:
        return list(range(len(store)))
    return [int(i) for i in np.flatnonzero(np.asarray(store.array("status")[:]) == 1)]


def _points(volume: Volume, name: str) -> Any:
    """Voxel centres with the plotted values, NaN where masked, and the mask as 1 and 0 under MASKED."""
    import pyvista as pv

    values = plotted_values(volume)
    origin = [float(volume.grid.axis(a)[0]) for a in "xyz"]
    grid = pv.ImageData(dimensions=volume.grid.shape[::-1], spacing=volume.grid.spacing, origin=origin)
    grid[name] = values.ravel()
    grid[MASKED] = (~np.isfinite(values)).astype(np.float32).ravel()
    return grid


def _surfaces(grid: Any, name: str, level: float) -> tuple[Any, Any]:
    """The isosurface outside of the mask, and the surface of the mask."""
    whole = grid.copy()
    whole[name] = filled(grid[name].reshape(grid.dimensions[::-1])).ravel()
    surface = whole.contour([level], scalars=name)
    if surface.n_points:
        surface = surface.clip_scalar(scalars=MASKED, value=0.5)
    return surface, whole.contour([0.5], scalars=MASKED)


def _with_vectors(grid: Any, vectors: np.ndarray) -> Any:
    """Voxel centres with the velocity under VECTORS, 0 where it is unknown."""
    whole = grid.copy()
    whole[VECTORS] = np.nan_to_num(vectors).reshape(3, -1).T
    return whole


def _arrows(grid: Any, vectors: np.ndarray) -> Any:
    """Arrows of the velocity at about ARROWS places along the longest edge; the longest reaches to the next but one."""
    import pyvista as pv

    step = max(1, max(grid.dimensions) // ARROWS)
    nx, ny, nz = grid.dimensions
    places = np.zeros((nz, ny, nx), dtype=bool)
    places[step // 2 :: step, step // 2 :: step, step // 2 :: step] = True
    speed = np.linalg.norm(np.nan_to_num(vectors), axis=0)
    places &= np.isfinite(vectors).all(axis=0) & (speed > SLOW * (speed.max() or 1.0))
    points = _with_vectors(grid, vectors).extract_points(places.ravel(), include_cells=False)
    if not points.n_points:
        return points
    factor = 2 * step * max(grid.spacing) / speed.max()
    return points.glyph(orient=VECTORS, scale=VECTORS, factor=factor, geom=pv.Arrow(shaft_radius=0.03, tip_radius=0.09))


def _streamlines(grid: Any, vectors: np.ndarray) -> Any:
    """Tubes along the velocity through places evenly spread over where it is known."""
    import pyvista as pv

    places = np.flatnonzero(np.isfinite(vectors).all(axis=0).ravel())
    if not len(places):
        return pv.PolyData()
    seeds = pv.PolyData(grid.points[places[:: max(1, len(places) // STREAMLINES)]])
    lines = _with_vectors(grid, vectors).streamlines_from_source(
        seeds, vectors=VECTORS, integration_direction="both", max_steps=400, terminal_speed=1e-6,
    )  # fmt: skip
    return lines.tube(radius=0.12 * max(grid.spacing)) if lines.n_points else lines


def _writer(path: Path, frames_per_second: float) -> Any:
    try:
        import imageio.v2 as imageio
        import pyvista  # noqa: F401

        if ending(path) == ".gif":
            return imageio.get_writer(path, mode="I", duration=1000 / frames_per_second, loop=0)
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise InputError(f"{error.name} is not installed; {install('movie')}", field="movie") from None
    # browsers and slides play yuv420p
    return imageio.get_writer(
        path, fps=frames_per_second, codec="libx264", quality=8, pixelformat="yuv420p", macro_block_size=2
    )


def _plain(quantity: str) -> tuple[str, str]:
    """Name and unit without mathematics, for VTK."""
    name, unit = LABELS.get(quantity, (quantity, "1"))
    plain = str.maketrans("⁻¹²³", "-123")
    return name.replace("n$_{ambient}$", "n_ambient"), re.sub("[⁻¹²³]+", lambda m: f"^{m[0].translate(plain)}", unit)


def _text(position: str) -> dict[str, Any]:
    return {"position": position, "color": "black", "font_size": 11}
