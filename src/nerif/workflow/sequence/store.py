"""The result of a sequence: a Zarr store with a chunk per frame, which xarray can open at any time.

`status` is written last: a frame that is incomplete when a run is killed counts as missing.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerif.common.conventions import InputError
from nerif.common.files import atomic, reading
from nerif.common.settings import with_present_names
from nerif.data.kinds import SEQUENCE_KIND, SEQUENCE_RESULT, check_kind
from nerif.data.measurement_file import BODIES, bodies_of
from nerif.data.measurement_sequence import MeasurementSequence, add_frames, check_store
from nerif.data.volume import Volume
from nerif.data.volume_sequence import FIELDS, VolumeSequence, score_names
from nerif.fields.network import Network, NeuralField
from nerif.fields.network_kinds import network_in
from nerif.fields.network_shape import NetworkShape
from nerif.geometry import Box, Grid
from nerif.geometry.body import Body
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction.bounds import in_units

__all__ = ["DONE", "FAILED", "MISSING", "Frame", "SequenceStore"]

MISSING, DONE, FAILED = 0, 1, 2


@dataclass(frozen=True)
class Frame:
    """The result of one frame."""

    field: NeuralField  #: with its weights
    volumes: Sequence[Volume]  #: to write
    scores: Sequence[dict[str, Any]]
    """By view and technique: `name`, `measured`, `cc` and `rms` of re-projection and measurement."""
    seconds: float  #: duration
    steps: int  #: of training
    attempts: int = 1  #: number


class SequenceStore(VolumeSequence):
    """A result on disk: volumes, the weights of their networks, and the outcome of each frame."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path)
        check_kind(path, SEQUENCE_RESULT)

    @classmethod
    def begin(
        cls, path: Path, sequence: MeasurementSequence, grid: Grid, quantities: Sequence[str], network: NetworkShape,
        attributes: dict[str, Any],
    ) -> SequenceStore:  # fmt: skip
        """Make a store without frames, in place of an earlier one.

        Parameters
        ----------
        sequence : with its instants and views
        grid, quantities : of the volumes
        attributes : settings and others, JSON
        """
        like, frames = sequence.fullest(), len(sequence)
        check_store(path, FIELDS)
        names = [kind.name for kind in like.techniques]
        about = {
            "kind": SEQUENCE_KIND,
            "network": vars(network),
            "views": list(like.names),
            "techniques": names,
            **attributes,
        }
        with atomic(path) as part:
            group = VolumeSequence.create(part, sequence.times, grid, quantities, like.n_ambient, about).group
            views, parameters = (
                len(like.names),
                sum(p.numel() for p in _network(about, grid.box, bodies=like.bodies).parameters()),
            )

            def add(name: str, kind: str, fill: float | str, meaning: str, **more: Any) -> None:
                add_frames(group, name, frames, (), (), kind, fill, long_name=meaning, **more)

            nan, per_view = float("nan"), ((views,), ("view",), "float64")
            for kind, (cc, rms) in score_names(like.techniques).items():
                of = f"re-projection and measured {kind.measured}"
                add_frames(group, cc, frames, *per_view, units="1", long_name=f"correlation of {of}")
                add_frames(group, rms, frames, *per_view, units=kind.unit, long_name=f"rms difference of {of}")
            add_frames(group, "weights", frames, (parameters,), ("parameter",), "float32", long_name="of the network")
            for name, array in sequence.body_arrays().items():
                group.create_array(
                    name, data=array.values, dimension_names=list(map(str, array.dims)), attributes=array.attrs
                )
            add("index_scale", "float64", nan, "field of one unit of network output")
            add("offset", "float64", nan, "network output of the ambient field")
            add("seconds", "float64", nan, "duration of the frame, s")  # as units: xarray would read a time span
            add("steps", "int32", 0, "steps of training")
            add("attempts", "int8", 0, "attempts at the frame")
            add("reason", "str", "", "reason of failure")
            flags = {"flag_values": [MISSING, DONE, FAILED], "flag_meanings": "missing done failed"}
            add("status", "int8", MISSING, "written last: the frame is complete", **flags)
        return cls(path)

    # -- frames --------------------------------------------------------------------------------------------------

    @property
    def symmetry(self) -> Symmetry | None:
        """Symmetry of the fields of all frames, mm, if any."""
        entries = self.attributes.get("symmetry")
        return Symmetry.from_entries(entries) if entries else None

    def bodies(self, index: int) -> tuple[Body, ...]:
        """Return the bodies in the flow of a frame."""
        arrays = {name: self.array(name) for name in BODIES if name in self.group}
        if not arrays:
            return ()
        moving = {name for name, array in arrays.items() if array.metadata.dimension_names[0] == "time"}
        return bodies_of({name: self.read(name, index if name in moving else slice(None)) for name in arrays})

    @property
    def status(self) -> np.ndarray:
        """(time,) MISSING, DONE or FAILED, as on disk now."""
        return self.read("status", slice(None))

    @property
    def reasons(self) -> list[str]:
        """(time,) reason of failure, or an empty text."""
        return [str(r) for r in self.read("reason", slice(None))]

    def write_frame(self, index: int, frame: Frame) -> None:
        """Write a frame, its status last."""
        self.write(index, frame.volumes)
        weights = [p.detach().cpu().float().reshape(-1) for p in frame.field.network.parameters()]
        self.array("weights")[index] = torch.cat(weights).numpy()
        self.array("index_scale")[index] = frame.field.scale
        self.array("offset")[index] = frame.field.offset
        for arrays in self.view_scores:
            scores = {s["name"]: s for s in frame.scores if s["measured"] == arrays.technique.measured}
            for name, array in (("cc", arrays.cc), ("rms", arrays.rms)):
                array[index] = np.array([scores.get(view, {}).get(name, np.nan) for view in self.attributes["views"]])
        for name in ("seconds", "steps", "attempts"):
            self.array(name)[index] = getattr(frame, name)
        self.array("reason")[index] = ""
        self.array("status")[index] = DONE

    def fail(self, index: int, reason: str, attempts: int) -> None:
        """Record a failed frame."""
        self.array("attempts")[index] = attempts
        self.array("reason")[index] = " ".join(reason.split())
        self.array("status")[index] = FAILED

    def forget_failures(self) -> int:
        """Mark failed frames as missing, and return their number."""
        failed = np.flatnonzero(self.status == FAILED)
        for index in failed:
            self.array("status")[int(index)] = MISSING
        return len(failed)

    def field(self, index: int) -> NeuralField:
        """Return the field of a complete frame."""
        if int(self.read("status", index)) != DONE:
            raise InputError(f"frame {index} is not done; run nerif sequence again for missing frames", field=self.path)
        with reading(f"{self.path}: made by another version of nerif, or damaged; reconstruct it again"):
            network = _network(
                self.attributes, self.grid.box, float(self.read("index_scale", index)), self.bodies(index),
                self.array("weights").shape[-1],
            )  # fmt: skip
        weights = torch.from_numpy(self.read("weights", index))
        scale, offset = (float(self.read(name, index)) for name in ("index_scale", "offset"))
        if len(weights) != sum(p.numel() for p in network.parameters()) or not bool(torch.isfinite(weights).all()):
            raise InputError(f"frame {index}: expected finite weights of its network; is it damaged?", field=self.path)
        if not math.isfinite(scale + offset):
            raise InputError(f"frame {index}: expected finite index_scale and offset; is it damaged?", field=self.path)
        at = 0
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.copy_(weights[at : at + parameter.numel()].reshape(parameter.shape))
                at += parameter.numel()
        network.eval().requires_grad_(False)
        return NeuralField(network, self.grid.box, scale, offset)

    def check_same(self, attributes: dict[str, Any]) -> None:
        """Check that attributes are those the store was begun with; the InputError names the first other one."""
        for name, new in json.loads(json.dumps(attributes)).items():
            old = self.attributes.get(name)
            if isinstance(new, dict) and isinstance(old, dict):
                old, new = with_present_names(old), with_present_names(new)
                # a store of an earlier version lacks later settings, which are empty by default
                key = next((k for k in new if new[k] != old.get(k) and (k in old or new[k])), None)
                name, old, new = (name, None, None) if key is None else (key, old.get(key), new[key])
            if old != new:
                raise InputError(
                    f"{name}: expected {old!r}, with which it was begun, got {new!r}; "
                    "give another --out, or --force to start again",
                    field=self.path,
                )


def _network(
    attributes: dict[str, Any], box: Box, scale: float = 1.0, bodies: Sequence[Body] = (), weights: float = math.inf
) -> Network:
    """Return a network of the shape, symmetry and bounds of a store, for a field in units of `scale`."""
    shape = NetworkShape.of(attributes["network"], weights)
    low, high = attributes.get("bounds", (None, None))  # no infinity in JSON
    bounds = in_units((-math.inf if low is None else low, math.inf if high is None else high), scale)
    symmetry = Symmetry.from_entries(attributes["symmetry"]) if attributes.get("symmetry") else None
    return network_in(box, shape, bounds, symmetry, bodies)
