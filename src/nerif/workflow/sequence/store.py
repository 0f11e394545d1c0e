"""The result of a sequence: a Zarr store with a chunk for each frame, which xarray opens at any time.

Volumes and the weights of the network are written first and `status` last, so that what a killed run leaves
half-written counts as missing and is done again.
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
from nerif.common.files import atomic
from nerif.common.netcdf import reading
from nerif.data.measurement_sequence import MeasurementSequence, add_frames, check_store
from nerif.data.volume import Volume
from nerif.data.volume_sequence import FIELDS, VolumeSequence, score_names
from nerif.fields.network import Network, NetworkShape, NeuralField
from nerif.fields.symmetric import SymmetricNetwork
from nerif.geometry import Box, Grid
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction.bounds import in_units

__all__ = ["DONE", "FAILED", "KIND", "MISSING", "Frame", "SequenceStore"]

KIND = "nerif sequence 1"  # attribute `kind` of the store
MISSING, DONE, FAILED = 0, 1, 2


@dataclass(frozen=True)
class Frame:
    """What came of one frame.

    Parameters
    ----------
    field : with its weights
    volumes : what is written of it
    scores : `name` of the view, `measured`, `cc` and `rms`: what it measured against what is re-projected
    seconds : spent on the frame
    steps : of training
    attempts : how many it took
    """

    field: NeuralField
    volumes: Sequence[Volume]
    scores: Sequence[dict[str, Any]]
    seconds: float
    steps: int
    attempts: int = 1


class SequenceStore(VolumeSequence):
    """A result on disc: volumes, the weights they come from, and how each frame went.

    Parameters
    ----------
    path : of the Zarr store

    Raises
    ------
    InputError
        If there is no such store, or it is none of ours.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path)
        if self.attributes.get("kind") != KIND:
            raise InputError(
                f"expected the result of nerif sequence (attribute kind '{KIND}'), got another", field=path
            )

    @classmethod
    def begin(
        cls,
        path: Path,
        sequence: MeasurementSequence,
        grid: Grid,
        quantities: Sequence[str],
        network: NetworkShape,
        attributes: dict[str, Any],
    ) -> SequenceStore:
        """Make a store in which every frame is missing; one that is there is replaced, checkpoints included.

        Parameters
        ----------
        sequence : whose instants and views it has
        grid, quantities : of the volumes
        attributes : settings and whatever else is to be kept, JSON

        Raises
        ------
        InputError
            If anything but a store of fields is there.
        """
        like, frames = sequence.fullest(), len(sequence)
        check_store(path, FIELDS)
        names = [kind.name for kind in like.techniques]
        about = {"kind": KIND, "network": vars(network), "views": list(like.names), "techniques": names, **attributes}
        with atomic(path) as part:
            group = VolumeSequence.create(part, sequence.times, grid, quantities, like.n_ambient, about).group
            views, parameters = len(like.names), sum(p.numel() for p in _network(about, grid.box).parameters())

            def add(name: str, kind: str, fill: float | str, meaning: str, **more: Any) -> None:
                add_frames(group, name, frames, (), (), kind, fill, long_name=meaning, **more)

            nan, seen = float("nan"), ((views,), ("view",), "float64")
            for kind, (cc, rms) in score_names(like.techniques).items():
                what = f"the {kind.measured} that the view measured"
                add_frames(group, cc, frames, *seen, units="1", long_name=f"correlation with {what}")
                add_frames(group, rms, frames, *seen, units=kind.unit, long_name=f"rms difference to {what}")
            add_frames(group, "weights", frames, (parameters,), ("parameter",), "float32", long_name="of the network")
            add("index_scale", "float64", nan, "field of one unit of network output")
            add("offset", "float64", nan, "network output that counts as ambient")
            add("seconds", "float64", nan, "spent on the frame, s")  # as units they would be read as a time span
            add("steps", "int32", 0, "steps of training")
            add("attempts", "int8", 0, "attempts at the frame")
            add("reason", "str", "", "why the frame failed")
            flags = {"flag_values": [MISSING, DONE, FAILED], "flag_meanings": "missing done failed"}
            add("status", "int8", MISSING, "written last: the frame is complete", **flags)
        return cls(path)

    # -- frames --------------------------------------------------------------------------------------------------

    @property
    def symmetry(self) -> Symmetry | None:
        """Of the fields of all frames, mm, if they have one."""
        kept = self.attributes.get("symmetry")
        return Symmetry.from_entries(kept) if kept else None

    @property
    def status(self) -> np.ndarray:
        """(time,) MISSING, DONE or FAILED, as it is on disc now."""
        return self.read("status", slice(None))

    @property
    def reasons(self) -> list[str]:
        """(time,) why a frame failed, or nothing."""
        return [str(r) for r in self.read("reason", slice(None))]

    def write_frame(self, index: int, frame: Frame) -> None:
        """Write a frame; it counts as done when the last of it is written."""
        self.write(index, frame.volumes)
        weights = [p.detach().cpu().float().reshape(-1) for p in frame.field.network.parameters()]
        self.array("weights")[index] = torch.cat(weights).numpy()
        self.array("index_scale")[index] = frame.field.scale
        self.array("offset")[index] = frame.field.offset
        for of in self.view_scores:
            own = {s["name"]: s for s in frame.scores if s["measured"] == of.technique.measured}
            for name, array in (("cc", of.cc), ("rms", of.rms)):
                array[index] = np.array([own.get(view, {}).get(name, np.nan) for view in self.attributes["views"]])
        for name in ("seconds", "steps", "attempts"):
            self.array(name)[index] = getattr(frame, name)
        self.array("reason")[index] = ""
        self.array("status")[index] = DONE

    def fail(self, index: int, reason: str, attempts: int) -> None:
        """Record that a frame failed, and why."""
        self.array("attempts")[index] = attempts
        self.array("reason")[index] = " ".join(reason.split())
        self.array("status")[index] = FAILED

    def forget_failures(self) -> int:
        """Count failed frames as missing again, and return how many there were."""
        failed = np.flatnonzero(self.status == FAILED)
        for index in failed:
            self.array("status")[int(index)] = MISSING
        return len(failed)

    def field(self, index: int) -> NeuralField:
        """Return the field of a frame that is done."""
        if int(self.read("status", index)) != DONE:
            raise InputError(
                f"frame {index} is not done; run nerif sequence again for what is missing", field=self.path
            )
        with reading(f"{self.path}: made by another version of nerif, or damaged; reconstruct it again"):
            network = _network(self.attributes, self.grid.box, float(self.read("index_scale", index)))
        weights, at = torch.from_numpy(self.read("weights", index)), 0
        scale, offset = (float(self.read(name, index)) for name in ("index_scale", "offset"))
        parameters = list(network.parameters())
        if len(weights) != sum(p.numel() for p in parameters) or not bool(torch.isfinite(weights).all()):
            raise InputError(f"frame {index}: expected finite weights of its network; is it damaged?", field=self.path)
        if not math.isfinite(scale + offset):
            raise InputError(f"frame {index}: expected finite index_scale and offset; is it damaged?", field=self.path)
        with torch.no_grad():
            for parameter in parameters:
                parameter.copy_(weights[at : at + parameter.numel()].reshape(parameter.shape))
                at += parameter.numel()
        network.eval().requires_grad_(False)
        return NeuralField(network, self.grid.box, scale, offset)

    def check_same(self, attributes: dict[str, Any]) -> None:
        """Refuse to go on with other settings than the store was begun with.

        Raises
        ------
        InputError
            Naming the first that differs.
        """
        for name, asked in json.loads(json.dumps(attributes)).items():
            kept = self.attributes.get(name)
            if isinstance(asked, dict) and isinstance(kept, dict):
                changed = [k for k in asked if asked[k] != kept.get(k)]
                if changed:
                    name, kept, asked = changed[0], kept.get(changed[0]), asked[changed[0]]
            if kept != asked:
                raise InputError(
                    f"{name}: expected {kept!r}, with which it was begun, got {asked!r}; "
                    "give another --out, or --force to begin anew",
                    field=self.path,
                )


def _network(attributes: dict[str, Any], box: Box, scale: float = 1.0) -> Network:
    """An empty network of the kind that a store was made with, for a field in a box in units of `scale`."""
    shape = NetworkShape.of(attributes["network"])
    low, high = attributes.get("bounds", (None, None))  # JSON knows no infinity
    bounds = in_units((-math.inf if low is None else low, math.inf if high is None else high), scale)
    if attributes.get("symmetry"):
        own = Symmetry.from_entries(attributes["symmetry"]).in_units(box.centre, max(box.edges) / 2)
        return SymmetricNetwork(shape, own, bounds)
    return Network(shape, bounds=bounds)
