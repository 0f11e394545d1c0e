"""The status of a live run, in its result directory.

    live.json    title, step, seconds, progress and losses with their curves: once a second at most
    live.npz     the field on a coarse grid, and one view as measured and predicted: as often as its duration allows

Both are written atomically, and once more after the last step; where that fails, as on a full disk, the run goes on
without them.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerif.common.files import atomic, read_json, reading, write_json
from nerif.common.npz import open_npz
from nerif.common.written_files import WARN, OwnFiles
from nerif.data.measurement import Measurement
from nerif.data.measurement_data import Observation
from nerif.data.quantity_names import describe
from nerif.data.volume import Volume
from nerif.fields.field import Field
from nerif.forward.forward_model import ForwardModel
from nerif.forward.model_names import AUTO
from nerif.forward.path_integral import PathIntegral, project
from nerif.forward.registry import forward_model
from nerif.geometry import Box, Grid
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.reconstructor import OnStep, Reconstructor, Step, compose, sampled
from nerif.reconstruction.rig_parameters import with_corrections
from nerif.reconstruction.uncertainty.bootstrap import best_covered
from nerif.results.directory import LIVE, LIVE_FIELD

__all__ = ["Live", "LiveSnapshot", "read_live", "read_snapshot"]

STATUS_INTERVAL = 1.0  # s, of live.json
FIELD_DELAY = 1.0  # s, before the first live.npz
FIELD_SHARE, FIELD_INTERVAL = 0.01, 20.0  # of the time that live.npz takes; s between two, where that would be longer,
MOST_SHARE = 0.1  # unless they then took more of the time than this
COARSE_VOXELS = 28  # along the longest edge of the box
MAX_PIXELS = 40  # along the longest edge of the view
RAY_SAMPLES = 24
CURVE_POINTS = 400  # at most; then every second is dropped


@dataclass(frozen=True)
class LiveSnapshot:
    """The field during a run, and one of its views."""

    title: str  #: of the work
    seconds: float  #: since its start
    quantity: str  #: of the field (volume.QUANTITIES)
    values: np.ndarray  #: [z, y, x] of it
    lower: tuple[float, float, float]  #: corner of its box, mm
    upper: tuple[float, float, float]
    view: str  #: name of the view; empty if there is none
    withheld: bool  #: whether the run does not use the view
    measured: np.ndarray
    """(row, column, component) of the view, on a lattice of pixels; NaN where not measured."""
    predicted: np.ndarray  #: the same from the field
    components: tuple[str, ...]  #: their names
    unit: str  #: of measured and predicted

    @property
    def volume(self) -> Volume:
        """The field on its grid."""
        grid = Grid(Box(self.lower, self.upper), self.values.shape)
        return Volume(torch.from_numpy(self.values), grid, self.quantity, describe(self.quantity)[0])


class Live:
    """Writes the status of a run into its directory.

    Parameters
    ----------
    directory : of the result; nothing is written before it exists
    measurement : with the view to show
    reconstructor : settings of the method, with its forward model
    view : name of the view; the one best covered by the others if empty
    remark : returns a line to show with the status, or ""
    """

    def __init__(
        self, directory: Path, measurement: Measurement, reconstructor: Reconstructor, view: str = "",
        remark: Callable[[], str] = str,
    ) -> None:  # fmt: skip
        self.directory, self.measurement, self.remark = directory, measurement, remark
        self.model = str(getattr(reconstructor, "model", AUTO))
        self.view = view or best_covered(measurement.cameras)[0]
        self._curve: list[dict[str, float]] = []
        self._interval, self._failed = 1, False

    def watching(self, monitor: Monitor, withheld: bool, snapshots: bool = True) -> Monitor:
        """Return a monitor that also writes the status.

        Parameters
        ----------
        withheld : whether the run does not use the view
        snapshots : whether to write the field
        """

        @contextmanager
        def training(title: str) -> Iterator[OnStep]:
            with monitor.training(title) as on_step:
                newest: list[Step] = []
                yield compose(self._writer(title, withheld, snapshots, newest), on_step)
            if newest:  # the last step
                self._attempt(self._write, title, newest[0])
                if snapshots:
                    self._attempt(self._write_snapshot, title, newest[0], withheld)

        return replace(monitor, training=training)

    def _writer(self, title: str, withheld: bool, snapshots: bool, newest: list[Step]) -> OnStep:
        status, field = time.monotonic(), time.monotonic() + FIELD_DELAY  # when each is due
        is_first = True
        self._curve, self._interval = [], 1

        def on_step(step: Step) -> None:
            nonlocal status, field, is_first
            if not self.directory.is_dir():
                return
            newest[:] = [step]
            self._append(step)
            now = time.monotonic()
            if now >= status:
                self._attempt(self._write, title, step)
                status = now + STATUS_INTERVAL
            if snapshots and now >= field:
                self._attempt(self._write_snapshot, title, step, withheld)
                end = time.monotonic()
                field, is_first = end + _pause(end - now, is_first), False

        return on_step

    def _attempt(self, write: Callable[..., None], *arguments: object) -> None:
        try:
            write(*arguments)
        except Exception as error:  # nothing that is only shown ends a run
            if not self._failed:
                WARN(f"live view: not written ({type(error).__name__}: {error}); the run goes on")
            self._failed = True

    def _append(self, step: Step) -> None:
        losses = {k: v for k, v in step.losses.items() if isinstance(v, float)}
        if step.step % self._interval == 0:
            self._curve.append({"step": step.step, "seconds": step.seconds, **losses})
        if len(self._curve) > CURVE_POINTS:
            self._curve, self._interval = self._curve[::2], 2 * self._interval

    def _write(self, title: str, step: Step) -> None:
        entries = {"title": title, "written": time.time(), "view": self.view, "remark": self.remark()}
        for name in ("step", "epoch", "seconds", "progress", "losses", "rays_per_second"):
            entries[name] = getattr(step, name)
        names = list(dict.fromkeys(name for point in self._curve for name in point))
        curve = {name: [point.get(name, float("nan")) for point in self._curve] for name in names}
        with OwnFiles(self.directory).writing(LIVE) as path:
            write_json(path, {**entries, "curve": curve})

    @torch.no_grad()
    def _write_snapshot(self, title: str, step: Step, withheld: bool) -> None:
        m, field = with_corrections(self.measurement, step.rig()), step.field()
        grid = Grid.of_resolution(m.box, COARSE_VOXELS)
        volume = sampled(field, grid, m.quantity, m.n_ambient, m.bodies, str(_device(field)))
        arrays: dict[str, np.ndarray] = {"values": volume.values.numpy()}
        about: dict[str, Any] = {
            "title": title, "seconds": step.seconds, "quantity": m.quantity, "lower": m.box.lower,
            "upper": m.box.upper, "withheld": withheld, "view": "", "components": (), "unit": "",
        }  # fmt: skip
        model = self._integral(m)
        if model is not None:
            observation, forward = model
            arrays["measured"], arrays["predicted"] = self._maps(m, field, observation, forward)
            about |= {"view": self.view, "components": observation.components, "unit": observation.technique.unit}
        with OwnFiles(self.directory).writing(LIVE_FIELD) as path, atomic(path) as part:
            np.savez(part, about=np.array(json.dumps(about)), **arrays)  # type: ignore[arg-type]

    def _integral(self, m: Measurement) -> tuple[Observation, ForwardModel] | None:
        """The first observation of the view that is an integral along rays."""
        index = m.names.index(self.view)
        for observation in m.observations:
            forward = forward_model(observation.technique, m, self.model)
            if not observation.technique.derived and bool(m.usable_for(observation)[index].any()):
                return observation, forward
        return None

    def _maps(
        self, m: Measurement, field: Field, observation: Observation, forward: ForwardModel
    ) -> tuple[np.ndarray, np.ndarray]:
        """The measured and the predicted view on a lattice of pixels."""
        index = m.names.index(self.view)
        camera = observation.technique.seen_by(m.cameras[index])
        height, width = camera.image_size
        step = -(-max(height, width) // MAX_PIXELS)
        pixels = camera.pixel_grid()[::step, ::step]
        rays = camera.rays(pixels.reshape(-1, 2)).clip(m.box).to(dtype=torch.float32)
        predicted = project(PathIntegral(forward, RAY_SAMPLES), field, rays, _device(field)).cpu()
        at = index, slice(0, height, step), slice(0, width, step)
        usable = m.usable_for(observation)[at][..., None]
        measured = observation.values[at].where(usable, torch.tensor(float("nan")))
        return measured.numpy(), predicted.reshape(*pixels.shape[:2], -1).numpy()


def _pause(duration: float, is_first: bool) -> float:
    """Time from one live.npz to the next, s; the first also compiles and imports, so says little about the others."""
    if is_first:
        return duration
    return min(duration / FIELD_SHARE, max(FIELD_INTERVAL, duration / MOST_SHARE))


def _device(field: Field) -> torch.device:
    network = getattr(field, "network", None)
    return torch.device("cpu") if network is None else next(network.parameters()).device


def read_live(directory: Path) -> dict[str, Any]:
    """Return live.json of a result directory; empty if there is none."""
    path = directory / LIVE
    return read_json(path) if path.is_file() else {}


def read_snapshot(directory: Path) -> LiveSnapshot | None:
    """Return the content of live.npz of a result directory; None if there is none."""
    path = directory / LIVE_FIELD
    if not path.is_file():
        return None
    with reading(f"{path}: not a preview of the field, or truncated"), open_npz(path) as (file, _):
        about = json.loads(str(file["about"]))
        empty = np.zeros((0, 0, 0), np.float32)
        for name in ("lower", "upper", "components"):
            about[name] = tuple(about[name])
        arrays = {name: file.get(name, empty) for name in ("measured", "predicted")}
        return LiveSnapshot(**about, values=file["values"], **arrays)
