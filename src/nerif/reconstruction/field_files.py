"""Field and checkpoint files: tensors in safetensors, the rest as JSON; digests of the data of a run."""

from __future__ import annotations

import errno
import hashlib
import json
import re
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.files import atomic, check_file
from nerif.common.written_files import OwnFiles
from nerif.data.kinds import FIELD, RESULT, check_kind
from nerif.data.measurement import Measurement
from nerif.data.quantity_names import INDEX
from nerif.fields.field import Field
from nerif.fields.network import Network, NeuralField
from nerif.fields.network_kinds import network_in
from nerif.fields.network_shape import NetworkShape
from nerif.fields.sum import SumField
from nerif.fields.symmetric import SymmetricNetwork, SymmetricVoxels
from nerif.fields.voxel_field import VoxelField
from nerif.fields.walls import WallNetwork
from nerif.forward.registry import forward_model
from nerif.geometry import Box, Camera, Grid
from nerif.geometry.body import Body
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction.reconstructor import OnStep, Reconstruction, State, Step
from nerif.reconstruction.rig_parameters import RefinedView

__all__ = [
    "CHECKPOINT", "FIELD", "check_fingerprint", "checkpoints", "digest", "digest_of_field", "fingerprint",
    "read_bodies", "read_field", "read_quantity", "read_rig", "read_state", "read_tensors", "write_field",
    "write_state", "write_tensors",
]  # fmt: skip

CHECKPOINT = "checkpoint.safetensors"
VERSION, WITH_BODIES = 1, 2  # of the field file
BODIES = "bodies."  # beginning of the names of their tensors


def fingerprint(
    measurement: Measurement, open_faces: tuple[str, ...] = (), refine: Sequence[str] = ()
) -> dict[str, str]:  # fmt: skip
    """Return digests of the parts of a measurement on which a reconstruction depends, by name.

    The uncertainty of the poses is one of them where a rig is refined.
    """
    maps: dict[str, str] = {}
    constants: dict[str, list[Any]] = {}
    for o in measurement.observations:
        usable = measurement.usable_for(o)
        whole = bool(usable.all())  # then nothing is copied
        for name, values in ((o.technique.measured, o.values), (o.technique.sigma, o.sigma)):
            maps[name] = digest([None if values is None else values.flatten(0, 2) if whole else values[usable]])
        for name, value in forward_model(o.technique, measurement).constants.items():
            constants.setdefault(name, []).append(value)
    return {
        "views": digest(measurement.names),
        "cameras": digest(part for camera in measurement.cameras for part in _parts(camera)),
        **maps,
        "valid pixels": digest([measurement.usable]),
        "flow_mask": digest([measurement.flow_mask]),
        **({"pose_sigma": digest(camera.pose_sigma for camera in measurement.cameras)} if refine else {}),
        **({"bodies": digest(_meshes(measurement.bodies).values())} if measurement.bodies else {}),
        "box": digest([measurement.box.lower, measurement.box.upper]),
        "n_ambient": digest([measurement.n_ambient]),
        **{name: digest(values) for name, values in constants.items()},
        "ambient_faces": digest(sorted(measurement.ambient_faces)),
        **({"ambient_region": digest(measurement.ambient_region)} if measurement.ambient_region else {}),
        "open_faces": digest(sorted(open_faces)),
    }


def check_fingerprint(before: dict[str, str] | None, present: dict[str, str]) -> None:
    """Raise InputError if a checkpoint is of other data; the message names the parts that differ."""
    if before is None:
        raise InputError(
            "the checkpoint has no fingerprint of its data, so it is of another version of nerif; "
            "start without --resume",
            field="resume",
        )
    changed = [name for name in dict.fromkeys([*present, *before]) if before.get(name) != present.get(name)]
    if changed:
        raise InputError(
            f"expected the data of the run to be resumed, got other {', '.join(changed)}; "
            "give the same measurement, --withhold and --open-faces, or start without --resume",
            field="resume",
        )


def _parts(camera: Camera) -> tuple[Any, ...]:
    plane = camera.background
    optics = camera.projection.name, camera.intrinsics, camera.rotation, camera.translation, camera.distortion
    tilt = (camera.tilt,) if bool(camera.tilt.any()) else ()
    lens: tuple[Any, ...] = () if camera.lens is None else (camera.lens.diameter, camera.lens.focus)
    lens += (camera.lens.window,) if camera.lens is not None and camera.lens.window else ()
    planes = [part for plane in camera.interfaces for part in (plane.normal, plane.offset, plane.index)]
    return (*optics, *tilt, *planes, camera.image_size, *(() if plane is None else (plane.normal, plane.offset)), *lens)


def digest(parts: Iterable[Any]) -> str:
    """Return a digest of tensors and plain values, in their order."""
    result = hashlib.blake2b(digest_size=16)
    for part in parts:
        if isinstance(part, Tensor):
            result.update(str(tuple(part.shape)).encode())
            result.update(part.contiguous().numpy().reshape(-1).view("uint8").data)
        else:
            result.update(repr(part).encode())
        result.update(b"|")
    return result.hexdigest()


def digest_of_field(field: Field) -> str:
    """Return a digest of a field."""
    tensors, entries = _entries_of(field)
    return digest([*tensors.values(), entries])


def write_field(directory: Path, result: Reconstruction) -> None:
    """Write a field atomically, with everything needed to evaluate it."""
    version = WITH_BODIES if result.bodies else VERSION
    about = {"version": version, "n_ambient": result.n_ambient, "outcome": vars(result.outcome)}
    about |= {"quantity": result.quantity}
    if result.bodies:
        about["bodies"] = [body.name for body in result.bodies]
    about |= {"rig": result.rig} if result.rig else {}
    tensors, entries = _entries_of(result.field)
    tensors |= _meshes(result.bodies)
    domain = _domain(result.field)
    if domain is not None and domain != result.box:
        about["domain"] = [domain.lower, domain.upper]
    write_tensors(directory / FIELD, tensors, {**about, "box": [result.box.lower, result.box.upper], **entries})


def _domain(field: Field) -> Box | None:
    """The box for which a field was made; None for splines of (r, h)."""
    if isinstance(field, SumField):
        return _domain(field.parts[0])
    if isinstance(field, NeuralField):
        return field.box
    return field.grid.box if isinstance(field, VoxelField) else None


def _meshes(bodies: Sequence[Body]) -> dict[str, Tensor]:
    """The tensors of bodies by their names in a file."""
    tensors: dict[str, Tensor] = {}
    for i, body in enumerate(bodies):
        tensors |= {f"{BODIES}{i}.vertices": body.vertices, f"{BODIES}{i}.faces": body.faces}
    return tensors


def read_bodies(directory: Path) -> tuple[Body, ...]:
    """Read the bodies in the flow of a result directory."""
    return _bodies_of(*read_tensors(directory / FIELD))


def _bodies_of(tensors: dict[str, Tensor], about: dict[str, Any]) -> tuple[Body, ...]:
    names = about.get("bodies", ())
    return tuple(
        Body(tensors[f"{BODIES}{i}.vertices"], tensors[f"{BODIES}{i}.faces"], name) for i, name in enumerate(names)
    )


def _entries_of(field: Field) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors of a field and the entries of its header."""
    if isinstance(field, SumField):
        tensors, parts = dict[str, Tensor](), list[dict[str, Any]]()
        for i, part in enumerate(field.parts):
            of_part, entries = _entries_of(part)
            tensors |= {f"{i}.{name}": tensor for name, tensor in of_part.items()}
            parts.append(entries)
        return tensors, {"kind": "sum", "parts": parts}
    if isinstance(field, VoxelField):
        entries = {"kind": "voxels", "shape": field.grid.shape, "degree": field.degree}
        return {"coefficients": field.coefficients.cpu().contiguous()}, entries
    if isinstance(field, SymmetricVoxels):
        grid = field.parts[0].grid
        entries = {"kind": "symmetric voxels", "shape": grid.shape, "degree": field.parts[0].degree}
        entries |= {"reduced_box": [grid.box.lower, grid.box.upper], "symmetry": asdict(field.symmetry)}
        return {"coefficients": torch.stack([part.coefficients.cpu() for part in field.parts])}, entries
    assert isinstance(field, NeuralField)
    entries = {"kind": "neural", "network": vars(field.network.shape)}
    if isinstance(field.network, SymmetricNetwork):
        entries["symmetry"] = asdict(field.network.symmetry)
    entries |= {"walls": True} if isinstance(field.network, WallNetwork) else {}
    entries |= {"index_scale": field.scale, "offset": field.offset}
    return {k: v.detach().cpu().contiguous() for k, v in field.network.state_dict().items()}, entries


def read_field(directory: Path) -> tuple[Field, Box, float]:
    """Read the field of a result directory, its box and n_ambient."""
    path = directory / FIELD
    if not path.is_file():
        check_kind(directory, RESULT)
        what = "the directory has no" if directory.is_dir() else "no such directory with a"
        raise InputError(f"expected a reconstruction, but {what} {FIELD}; run nerif reconstruct first", field=directory)
    tensors, about = read_tensors(path)
    if about.get("version", 1) not in (VERSION, WITH_BODIES):
        raise InputError(
            f"expected version {VERSION} or {WITH_BODIES} of fields, got {about['version']}; read it with a later "
            "version of nerif",
            field=path,
        )
    try:
        lower, upper = about["box"]
        box = Box(tuple(lower), tuple(upper))
        parts = {name: tensor for name, tensor in tensors.items() if not name.startswith(BODIES)}
        lower, upper = about.get("domain", about["box"])
        domain = Box(tuple(lower), tuple(upper))
        return _field_of(parts, about, domain, _bodies_of(tensors, about)), box, float(about["n_ambient"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(
            f"not a field of this version of nerif ({type(error).__name__}: {error})", field=path
        ) from None


def _field_of(tensors: dict[str, Tensor], about: dict[str, Any], box: Box, bodies: Sequence[Body]) -> Field:
    """The field of tensors and the entries of its header."""
    if about["kind"] == "sum":
        whole = State(tensors, {})
        parts = [_field_of(whole.under(f"{i}."), entries, box, bodies) for i, entries in enumerate(about["parts"])]
        return SumField(*parts)
    if about["kind"] == "voxels":
        return VoxelField(tensors["coefficients"], Grid(box, tuple(about["shape"])), int(about["degree"]))
    if about["kind"] == "symmetric voxels":
        lower, upper = about["reduced_box"]
        grid = Grid(Box(tuple(lower), tuple(upper)), tuple(about["shape"]))
        planes = [VoxelField(c, grid, int(about["degree"])) for c in tensors["coefficients"]]
        return SymmetricVoxels(planes, Symmetry.from_entries(about["symmetry"]))
    shape = NetworkShape.of(about["network"], sum(tensor.numel() for tensor in tensors.values()))
    if "symmetry" in about:  # in network coordinates
        network: Network = SymmetricNetwork(shape, Symmetry.from_entries(about["symmetry"]))
    else:
        network = network_in(box, shape, bodies=bodies if about.get("walls") else ())
    network.load_state_dict(tensors)
    network.eval().requires_grad_(False)
    return NeuralField(network, box, float(about["index_scale"]), float(about["offset"]))


def read_quantity(directory: Path) -> str:
    """Read the quantity of the field of a result directory (volume.QUANTITIES)."""
    return str(read_tensors(directory / FIELD)[1].get("quantity", INDEX))


def read_rig(directory: Path) -> list[RefinedView]:
    """Read the corrections of the cameras of a result directory; none if they were not refined."""
    return list(read_tensors(directory / FIELD)[1].get("rig", ()))


def write_state(directory: Path, state: State) -> None:
    """Write a checkpoint atomically: a run killed while writing leaves the previous one."""
    write_tensors(directory / CHECKPOINT, {k: v.cpu().contiguous() for k, v in state.tensors.items()}, state.scalars)


def checkpoints(directory: Path, seconds: float) -> OnStep:
    """Return a callback that writes checkpoints at intervals of some seconds."""
    last = time.monotonic()

    def write(step: Step) -> None:
        nonlocal last
        if time.monotonic() - last >= seconds:
            directory.mkdir(parents=True, exist_ok=True)
            write_state(directory, step.capture())
            last = time.monotonic()

    return write


def read_state(directory: Path) -> State:
    """Read the checkpoint of a result directory."""
    path = directory / CHECKPOINT
    if not path.is_file():
        raise InputError(f"expected {CHECKPOINT} to resume from, got none; start without --resume", field=directory)
    return State(*read_tensors(path))


def write_tensors(path: Path, tensors: dict[str, torch.Tensor], about: dict[str, Any]) -> None:
    """Write tensors, and other values as JSON, atomically."""
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    with OwnFiles(path.parent).writing(path.name), atomic(path) as part:
        part.touch()
        mode = part.stat().st_mode  # as the user's umask has it; safetensors makes files that only the user can read
        try:
            save_file(tensors, part, metadata={"nerif": json.dumps(about)})
        except SafetensorError as error:  # safetensors has no OSError for a full disk
            code = re.search(r"os error (\d+)", str(error))
            raise OSError(int(code[1]) if code else errno.EIO, f"cannot be written ({error})", str(path)) from None
        part.chmod(mode)


def read_tensors(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Read tensors, and the other values, of a file of `write_tensors`."""
    from safetensors import SafetensorError, safe_open

    check_file(path)
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {})["nerif"])
            # copies: Windows replaces no file that is mapped into memory, as a checkpoint after --resume
            return {name: file.get_tensor(name).clone() for name in file.keys()}, about  # noqa: SIM118
    except (SafetensorError, OSError, KeyError, ValueError, RecursionError) as error:
        raise InputError(f"damaged or not written by nerif ({error})", field=path) from None
