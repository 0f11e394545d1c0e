"""How a run goes on, for whoever looks at its directory meanwhile.

    live.json    the title of the work, step, seconds, progress, losses, and their curve: once a second at most
    live.npz     the field on a few voxels, one view as measured and predicted: as often as SHARE of the time allows

Both appear whole or not at all. A look at the field costs a twentieth of a second or so; after it, so much time passes
that all looks together take no more than SHARE of the run.
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

from nerif.common.files import atomic, write_json
from nerif.common.written_files import OwnFiles
from nerif.data.measurement import Measurement, Observation
from nerif.data.volume import Volume, describe
from nerif.fields.base import Field
from nerif.forward.base import ForwardModel
from nerif.forward.path_integral import PathIntegral, project
from nerif.forward.registry import AUTO, forward_model
from nerif.geometry import Box, Grid
from nerif.reconstruction.base import OnStep, Reconstructor, Step, compose
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.uncertainty.bootstrap import best_covered
from nerif.results.directory import LIVE, LIVE_LOOK

__all__ = ["Live", "Look", "read_live", "read_look"]

EVERY = 1.0  # seconds between two writings of live.json
SHARE = 0.01  # of the time that looks at the field take
FIRST = 1.0  # seconds before the first
VOXELS = 28  # along the longest edge of the box
PIXELS = 40  # along the longest edge of the view
SAMPLES = 24  # a ray
POINTS = 400  # of the curve: of more, every second is left out


@dataclass(frozen=True)
class Look:
    """The field as it was, and a view of it.

    Parameters
    ----------
    title : of the work meanwhile
    seconds : spent until then
    quantity : what the field is (volume.QUANTITIES)
    values : [z, y, x] of it
    lower, upper : corners of its box, mm
    view : name of the view; empty where there is none
    withheld : whether the work does without the view
    measured, predicted : (row, column, component) of the view, on every so many pixels; NaN where not measured
    components : their names
    unit : of measured and predicted
    """

    title: str
    seconds: float
    quantity: str
    values: np.ndarray
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    view: str
    withheld: bool
    measured: np.ndarray
    predicted: np.ndarray
    components: tuple[str, ...]
    unit: str

    @property
    def volume(self) -> Volume:
        """The field on its voxels."""
        grid = Grid(Box(self.lower, self.upper), self.values.shape)
        return Volume(torch.from_numpy(self.values), grid, self.quantity, describe(self.quantity)[0])


class Live:
    """Writes how a run goes on into its directory.

    Parameters
    ----------
    directory : of the result; nothing is written before it is there
    measurement : of which a view is shown
    reconstructor : settings of the method, whose forward model the view is predicted by
    view : its name; the one that the others cover best if empty
    remark : gives a line to be shown beside the figures, empty where there is none
    """

    def __init__(
        self, directory: Path, measurement: Measurement, reconstructor: Reconstructor, view: str = "",
        remark: Callable[[], str] = str,
    ) -> None:  # fmt: skip
        self.directory, self.measurement, self.remark = directory, measurement, remark
        self.model = str(getattr(reconstructor, "model", AUTO))
        self.view = view or best_covered(measurement.cameras)[0]
        self._curve: list[dict[str, float]] = []
        self._every = 1

    def watching(self, monitor: Monitor, withheld: bool, looks: bool = True) -> Monitor:
        """Return a monitor that also tells the directory.

        Parameters
        ----------
        withheld : whether the work is done without the view
        looks : whether to look at the field; of repetitions of a run there is nothing new to see
        """

        @contextmanager
        def training(title: str) -> Iterator[OnStep]:
            with monitor.training(title) as told:
                last: list[Step] = []
                yield compose(self._teller(title, withheld, looks, last), told)
            if last:  # where it ended
                self._write(title, last[0])

        return replace(monitor, training=training)

    def _teller(self, title: str, withheld: bool, looks: bool, newest: list[Step]) -> OnStep:
        begun = time.monotonic()
        written, spent, last = -EVERY, 0.0, 0.0
        self._curve, self._every = [], 1

        def tell(step: Step) -> None:
            nonlocal written, spent, last
            if not self.directory.is_dir():
                return
            newest[:] = [step]
            self._remember(step)
            now = time.monotonic()
            if now - written >= EVERY:
                self._write(title, step)
                written = now
            if looks and now - begun >= FIRST and spent + last <= SHARE * (now - begun):
                self._look(title, step, withheld)
                last = time.monotonic() - now
                spent += last

        return tell

    def _remember(self, step: Step) -> None:
        losses = {k: v for k, v in step.losses.items() if isinstance(v, float)}
        if step.step % self._every == 0:
            self._curve.append({"step": step.step, "seconds": step.seconds, **losses})
        if len(self._curve) > POINTS:
            self._curve, self._every = self._curve[::2], 2 * self._every

    def _write(self, title: str, step: Step) -> None:
        entries = {"title": title, "written": time.time(), "view": self.view, "remark": self.remark()}
        for name in ("step", "epoch", "seconds", "progress", "losses", "rays_per_second"):
            entries[name] = getattr(step, name)
        names = list(dict.fromkeys(name for point in self._curve for name in point))
        curve = {name: [point.get(name, float("nan")) for point in self._curve] for name in names}
        with OwnFiles(self.directory).writing(LIVE) as path:
            write_json(path, {**entries, "curve": curve})

    @torch.no_grad()
    def _look(self, title: str, step: Step, withheld: bool) -> None:
        m, field = self.measurement, step.field()
        grid = Grid.of_resolution(m.box, VOXELS)
        arrays: dict[str, np.ndarray] = {"values": field.sample(grid, _device(field)).numpy()}
        about: dict[str, Any] = {"title": title, "seconds": step.seconds, "quantity": m.quantity}
        about |= {"lower": m.box.lower, "upper": m.box.upper, "withheld": withheld}
        about |= {"view": "", "components": (), "unit": ""}
        shown = self._shown()
        if shown is not None:
            observation, forward = shown
            measured, predicted = self._seen(field, observation, forward)
            arrays |= {"measured": measured, "predicted": predicted}
            about |= {"view": self.view, "components": observation.components, "unit": observation.technique.unit}
        with OwnFiles(self.directory).writing(LIVE_LOOK) as path, atomic(path) as part:
            np.savez(part, about=np.array(json.dumps(about)), **arrays)  # type: ignore[arg-type]

    def _shown(self) -> tuple[Observation, ForwardModel] | None:
        """What of the view is shown: the first that is an integral along rays, if any is."""
        index = self.measurement.names.index(self.view)
        for observation in self.measurement.observations:
            forward = forward_model(observation.technique, self.measurement, self.model)
            if forward.integral is forward and bool(self.measurement.usable_for(observation)[index].any()):
                return observation, forward
        return None

    def _seen(self, field: Field, observation: Observation, forward: ForwardModel) -> tuple[np.ndarray, np.ndarray]:
        """The view on a lattice of pixels, as measured and as predicted."""
        m, index = self.measurement, self.measurement.names.index(self.view)
        camera = observation.technique.seen_by(m.cameras[index])
        height, width = camera.image_size
        step = -(-max(height, width) // PIXELS)
        pixels = camera.pixel_grid()[::step, ::step]
        rays = camera.rays(pixels.reshape(-1, 2)).clip(m.box).to(dtype=torch.float32)
        predicted = project(PathIntegral(forward, SAMPLES), field, rays, _device(field)).cpu()
        at = index, slice(0, height, step), slice(0, width, step)
        usable = m.usable_for(observation)[at][..., None]
        measured = observation.values[at].where(usable, torch.tensor(float("nan")))
        return measured.numpy(), predicted.reshape(*pixels.shape[:2], -1).numpy()


def _device(field: Field) -> torch.device:
    """Where the field is while it is found."""
    network = getattr(field, "network", None)
    return torch.device("cpu") if network is None else next(network.parameters()).device


def read_live(directory: Path) -> dict[str, Any]:
    """Return live.json of a result directory; nothing where there is none."""
    path = directory / LIVE
    return json.loads(path.read_text()) if path.is_file() else {}


def read_look(directory: Path) -> Look | None:
    """Return what live.npz of a result directory holds; None where there is none."""
    path = directory / LIVE_LOOK
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as file:
        about = json.loads(str(file["about"]))
        empty = np.zeros((0, 0, 0), np.float32)
        for name in ("lower", "upper", "components"):
            about[name] = tuple(about[name])
        arrays = {name: file.get(name, empty) for name in ("measured", "predicted")}
        return Look(**about, values=file["values"], **arrays)
