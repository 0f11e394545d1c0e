"""Ten thousand files with mistakes in them: each is refused in one line, or gives a finite field."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io
import torch

from mutation.mutators import make
from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera, write_cameras
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.volume import Volume, export, write_netcdf
from nerif.data.volume_file import read_volume
from nerif.fields.network_shape import NetworkShape
from nerif.fields.phantoms import GaussianBalls
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Camera, Grid, Ring
from nerif.imaging.calibration.importers.importers import import_cameras
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.simulation.simulate import simulate
from nerif.workflow.sequence.store import Frame, SequenceStore

pytest.importorskip("zarr", reason="pip install '.[sequence]'")

VOXELS = Tikhonov(voxels=6, device="cpu", iterations=2, coarse_to_fine=False, regularisation=1e-3)
NETWORK = NeRIF(
    network=NetworkShape(depth=2, width=8, octaves=1), max_steps=2, samples=(4, 4), sample_jitter=1,
    points_per_batch=64, device="cpu", precision="float32",
)  # fmt: skip
BOX = Box((-6.0, -5.0, -4.0), (6.0, 5.0, 4.0))
QUICK = 16
"""Mutants of each kind in `make test`."""
MANY = {
    "m.nc": 3400, "v.nc": 1400, "v.vti": 800, "c.toml": 1000, "c.csv": 400, "c.json": 400, "c.yml": 400, "c.mat": 400,
    "m.zarr": 1000, "r.zarr": 800,
}  # fmt: skip
"""Mutants of each kind in `make test-all`: ten thousand."""
BLOCK = 200


def field_of(measurement: Measurement, also_network: bool = True) -> torch.Tensor:
    """What tiny reconstructions make of it."""
    grid = Grid.of_resolution(measurement.box, 5)
    methods = (VOXELS, NETWORK) if also_network else (VOXELS,)
    return torch.cat([method(measurement).field.sample(grid).reshape(-1) for method in methods])


def of_measurement(path: Path) -> torch.Tensor:
    return field_of(Measurement.read(path), int(path.stem.split("-")[1]) % 4 == 0)


def of_volume(path: Path) -> torch.Tensor:
    volume = read_volume(path)
    if volume.quantity != "index_excess":  # no phantom, and none that could be taken for one
        return torch.zeros(1)
    return VoxelField.through(volume.values, volume.grid).sample(Grid.of_resolution(volume.grid.box, 5))


def of_calibration(path: Path) -> torch.Tensor:
    pixels = torch.tensor([[0.0, 0.0], [4.0, 3.0]], dtype=torch.float64)
    problems = []
    for camera in import_cameras(path):
        whole = camera.camera(camera.image_size or (8, 10), camera.background or RIG[0].background)
        rays = whole.rays(pixels).clip(BOX)
        problems += [rays.origin, rays.direction, rays.near, rays.far]
    return torch.cat([f.reshape(-1) for f in problems])


def of_film(path: Path) -> torch.Tensor:
    return field_of(MeasurementSequence.read(path).frame(1), False)


def of_result(path: Path) -> torch.Tensor:
    result = SequenceStore(path)
    return result.field(0).sample(result.grid)


OUTCOMES: dict[str, Callable[[Path], torch.Tensor]] = {
    "m.nc": of_measurement, "v.nc": of_volume, "v.vti": of_volume, "c.toml": of_calibration, "c.csv": of_calibration,
    "c.json": of_calibration, "c.yml": of_calibration, "c.mat": of_calibration, "m.zarr": of_film, "r.zarr": of_result,
}  # fmt: skip
RIG = Ring(views=3, arc=(0.0, 120.0), image_size=(8, 10), pixel_pitch=0.12).cameras()


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a good file of each kind, all optional variables in it."""
    folder = tmp_path_factory.mktemp("good")
    ball = GaussianBalls(torch.zeros(1, 3).double(), torch.tensor([1.5]).double(), torch.tensor([-2e-4]).double())
    m = simulate(ball, RIG, BOX, 1.00027, noise=0.05, steps=8, wavelength_nm=532.0)
    visible = torch.ones(m.displacement.shape[:3], dtype=torch.bool)
    m = replace(m, valid=visible, flow_mask=visible)
    m.write(folder / "m.nc")
    grid = Grid.of_resolution(BOX, 6)
    volumes = [
        Volume(ball.sample(grid), grid, attributes={"n_ambient": 1.00027, "gas": "air"}),
        Volume(ball.sample(grid).double() + 1.00027, grid, "n", attributes={"n_ambient": 1.00027}),
    ]
    write_netcdf(folder / "v.nc", volumes)
    export(folder / "v.vti", volumes)
    calibrations(folder)
    film = MeasurementSequence.create(folder / "m.zarr", (0.0, 1e-3), m)
    for i in range(2):
        film.write_frame(i, m)
    reconstruction = NETWORK(m)
    excess = Volume(reconstruction.field.sample(grid), grid)
    film = MeasurementSequence.read(folder / "m.zarr")
    result = SequenceStore.begin(folder / "r.zarr", film, grid, ("index_excess",), NETWORK.network, {})
    for i in range(2):
        result.write_frame(i, Frame(reconstruction.field, [excess], [], seconds=1.0, steps=2))
    return folder


def calibrations(folder: Path) -> None:
    write_cameras(folder / "c.toml", [CalibratedCamera.from_camera(c) for c in RIG], {"rms_px": 0.1})
    rows, frames = [], []
    for c in RIG:
        numbers = {f"r{i + 1}{j + 1}": float(c.rotation[i, j]) for i in range(3) for j in range(3)}
        numbers |= {f"t{a}": float(c.translation[i]) for i, a in enumerate("xyz")}
        k = c.intrinsics
        numbers |= {"fx": float(k[0, 0]), "fy": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2])}
        rows.append(numbers | {"width": 10, "height": 8, "nx": 1.0, "ny": 0.0, "nz": 0.0, "offset": -500.0})
        matrix = np.eye(4)
        matrix[:3, :3] = c.rotation.T.numpy()
        frames.append({"file_path": c.name, "transform_matrix": matrix.tolist()})
    lines = [",".join(rows[0]), *(",".join(map(str, row.values())) for row in rows)]
    (folder / "c.csv").write_text("\n".join(lines) + "\n")
    about = {"w": 10, "h": 8, "fl_x": 400.0, "fl_y": 400.0, "cx": 5.0, "cy": 4.0, "k1": 0.01, "frames": frames}
    (folder / "c.json").write_text(json.dumps(about, indent=1))
    storage = cv2.FileStorage(str(folder / "c.yml"), cv2.FILE_STORAGE_WRITE)
    for key, value in (("image_width", 10), ("image_height", 8), ("camera_model", "pinhole")):
        storage.write(key, value)
    for i, c in enumerate(RIG, 1):
        numbered = {"K": c.intrinsics, "D": c.distortion, "R": c.rotation, "T": c.translation}
        for key, matrix in numbered.items():
            storage.write(f"{key}{i}", matrix.numpy())
    storage.release()
    of_matlab = {"toolbox": to_struct(RIG[0]), "bouguet": bouguet(RIG[1]), "plain": plain(RIG[2])}
    scipy.io.savemat(folder / "c.mat", of_matlab)


def to_struct(camera: Camera) -> dict[str, Any]:
    """Fields of MATLAB's cameraParameters."""
    k, r, t = camera.intrinsics.clone(), camera.rotation.numpy(), camera.translation.numpy()
    k[:2, 2] += 1
    return {
        "K": k.numpy(), "RadialDistortion": np.array([-0.1, 0.05]), "TangentialDistortion": np.array([0.001, -0.002]),
        "ImageSize": np.array([8.0, 10.0]), "RotationVectors": np.stack([cv2.Rodrigues(r)[0].ravel()] * 2),
        "TranslationVectors": np.stack([t, t]), "WorldUnits": "millimeters", "EstimateSkew": True,
    }  # fmt: skip


def bouguet(camera: Camera) -> dict[str, Any]:
    """Variables of Bouguet's toolbox."""
    k = camera.intrinsics.numpy()
    return {
        "fc": k[[0, 1], [0, 1]][:, None], "cc": k[:2, 2:], "alpha_c": np.zeros((1, 1)), "kc": np.zeros((5, 1)),
        "nx": 10.0, "ny": 8.0, "Rc_1": camera.rotation.numpy(), "Tc_1": camera.translation.numpy()[:, None],
    }  # fmt: skip


def plain(camera: Camera) -> dict[str, Any]:
    """K, R, t."""
    k, r, t = camera.intrinsics.numpy(), camera.rotation.numpy(), camera.translation.numpy()
    return {"K": k, "R": r, "t": t, "distortion": np.zeros(5), "image_size": np.array([8.0, 10.0])}


def outcome(good: Path, kind: str, number: int, folder: Path) -> tuple[Path, str, str]:
    """Where the mutant is, the line it is refused with, and what is wrong with that, if anything is."""
    path, done = make(good / kind, number, folder)
    line = wrong = ""
    try:
        field = OUTCOMES[kind](path)
        if not bool(torch.isfinite(field).all()):
            wrong = "field is not finite"
    except InputError as error:
        line = str(error)
        if not line.strip():
            wrong = "refused without a word"
    except Exception as error:  # anything else is what this test looks for
        wrong = f"{type(error).__name__}: {error}"
    return path, line, f"{kind} mutant {number} ({done}): {wrong}" if wrong else ""


def remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", OUTCOMES)
def test_mutants_are_refused_in_one_line_or_give_a_finite_field(good, kind, tmp_path, capfd):
    problems, refused = [], []
    for number in range(QUICK):
        path, line, wrong = outcome(good, kind, number, tmp_path)
        problems += [wrong] if wrong else []
        refused += [path] if line else []
    assert not problems, "\n".join(problems)
    assert 0 < len(refused) < QUICK
    assert capfd.readouterr().err == ""  # no library has its own say
    if kind in ("m.nc", "v.vti", "r.zarr"):
        for path in refused[:5]:
            assert main(["info", str(path)]) == 2
            assert len(capfd.readouterr().err.splitlines()) == 1


BLOCKS = [(kind, first) for kind, count in MANY.items() for first in range(0, count, BLOCK)]


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("kind", "first"), BLOCKS)
def test_ten_thousand_mutants(good, kind, first, tmp_path):
    problems = []
    for number in range(first, min(first + BLOCK, MANY[kind])):
        path, _, wrong = outcome(good, kind, number, tmp_path)
        problems += [wrong] if wrong else []
        remove(path)
    assert not problems, "\n".join(problems)


def test_there_are_ten_thousand():
    assert sum(MANY.values()) == 10_000
