"""Ten thousand damaged images and as many other files: each is refused in one line, or gives something finite, soon and
in little memory; no library prints messages of its own.
"""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io
import torch

from imaging_files import CIHX, packed, write_b16, write_cine, write_cv, write_dng, write_packed_tiff
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
from nerif.imaging.readers.open import open_frames
from nerif.reconstruction.device import peak_memory
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.simulation.simulate import simulate
from nerif.workflow.sequence.store import Frame, SequenceStore

pytest.importorskip("zarr", reason="pip install '.[sequence]'")

QUICK = 16
"""Mutants of each kind in `make test`."""
LONGEST = 20.0
"""Seconds for a file that takes milliseconds: these machines are shared."""
MOST_MEMORY = 2**31
"""Growth of the process over all mutants of a kind, bytes: a damaged size must not be allocated."""
BLOCK = 200

# -- images ---------------------------------------------------------------------------------------------------------

STACK = np.random.default_rng(3).integers(0, 4096, (3, 24, 33)).astype(np.uint16)


def tiff(**options: object) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import tifffile

        tifffile.imwrite(path, STACK, **options)

    return write


def lzw(path: Path) -> None:
    from PIL import Image

    images = [Image.fromarray((image >> 4).astype(np.uint8)) for image in STACK]
    images[0].save(path, save_all=True, append_images=images[1:], compression="tiff_lzw")


def picture(path: Path) -> None:
    write_cv(path, (STACK[0] >> 4).astype(np.uint8))


def photron(path: Path) -> None:
    n, height, width = STACK.shape
    settings = {"rate": 2000, "bit": 12, "depth": 12, "side": "Lower", "kind": "MRaw"}
    path.write_text(CIHX.format(n=n, h=height, w=width, **settings))
    path.with_suffix(".mraw").write_bytes(packed(STACK))


def cine(path: Path) -> None:
    frames = [packed(image, 10) for image in STACK >> 2]
    write_cine(path, frames, *STACK.shape[1:], bits=10, packing=256, times=(0.0, 0.001, 0.002))


def hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file["images"] = STACK
        file["time"] = np.arange(3) / 2000


def video(codec: str, pixels: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        av = pytest.importorskip("av", reason="pip install '.[video]'")
        with av.open(str(path), "w") as file:
            stream = file.add_stream(codec, rate=30)
            stream.height, stream.width, stream.pix_fmt = 32, 48, pixels
            for image in np.random.default_rng(4).integers(0, 256, (3, 32, 48)).astype(np.uint8):
                file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray").reformat(format=pixels)))
            file.mux(stream.encode())

    return write


def dng(path: Path) -> None:
    pytest.importorskip("rawpy", reason="pip install '.[raw]'")
    write_dng(path, np.random.default_rng(5).integers(0, 4096, (48, 64)).astype(np.uint16), b"\0\1\1\2", 64, 4095)


IMAGES: dict[str, Callable[[Path], None]] = {
    "plain.tif": tiff(photometric="minisblack"), "imagej.tif": tiff(imagej=True), "lzw.tif": lzw,
    "deflate.tif": tiff(compression="zlib", photometric="miniswhite"), "grey.png": picture, "grey.bmp": picture,
    "grey.jpg": picture, "film.cihx": photron, "packed.tif": lambda path: write_packed_tiff(path, STACK >> 2, 10, 5),
    "film.cine": cine, "film.avi": video("rawvideo", "gray"), "film.mp4": video("libx264", "yuv420p"),
    "image.b16": lambda path: write_b16(path, STACK[0]), "image.dng": dng,
    "stack.npy": lambda path: np.save(path, STACK), "stack.npz": lambda path: np.savez(path, images=STACK),
    "stack.h5": hdf5,
}  # fmt: skip
"""How to write the good file of each kind."""


def of_images(path: Path) -> torch.Tensor:
    """The largest grey values of up to four images."""
    frames, errors, largest = open_frames(path), list[InputError](), list[float]()
    for i in range(min(4, len(frames))):
        try:
            image = frames[i]
        except InputError as error:
            errors.append(error)
            continue
        assert image.ndim == 2
        assert image.dtype in (np.uint8, np.uint16, np.float32)
        largest.append(float(image.sum(dtype=np.float64)))
    if errors and not largest:
        raise errors[0]
    return torch.tensor(largest)


# -- fields ----------------------------------------------------------------------------------------------------------

VOXELS = Tikhonov(voxels=6, device="cpu", iterations=2, coarse_to_fine=False, regularisation=1e-3)
NETWORK = NeRIF(
    network=NetworkShape(depth=2, width=8, octaves=1), max_steps=2, samples=(4, 4), sample_jitter=1,
    points_per_batch=64, device="cpu", precision="float32",
)  # fmt: skip
BOX = Box((-6.0, -5.0, -4.0), (6.0, 5.0, 4.0))


def field_of(measurement: Measurement, also_network: bool = True) -> torch.Tensor:
    """What tiny reconstructions make of it."""
    grid = Grid.of_resolution(measurement.box, 5)
    methods = (VOXELS, NETWORK) if also_network else (VOXELS,)
    return torch.cat([method(measurement).field.sample(grid).reshape(-1) for method in methods])


def of_measurement(path: Path) -> torch.Tensor:
    return field_of(Measurement.read(path), path.stem.endswith(("0", "5")))


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


RIG = Ring(views=3, arc=(0.0, 120.0), image_size=(8, 10), pixel_pitch=0.12).cameras()
OUTCOMES: dict[str, tuple[Callable[[Path], torch.Tensor], int]] = {
    "m.nc": (of_measurement, 3400), "v.nc": (of_volume, 1400), "v.vti": (of_volume, 800),
    "c.toml": (of_calibration, 1000), **dict.fromkeys(("c.csv", "c.json", "c.yml", "c.mat"), (of_calibration, 400)),
    "m.zarr": (of_film, 1000), "r.zarr": (of_result, 800),
    **dict.fromkeys(IMAGES, (of_images, math.ceil(10_000 / len(IMAGES)))),
}  # fmt: skip
"""What to make of a file of each kind, and the number of its mutants in `make test-all`."""


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a good file of each kind, all optional variables in it."""
    folder = tmp_path_factory.mktemp("good")
    for name, write in IMAGES.items():
        write(folder / name)
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


def refusal(path: Path, kind: str) -> tuple[str, str]:
    """The line with which a mutant is refused, and what is wrong with that, if anything is."""
    start, line, wrong = time.perf_counter(), "", ""
    try:
        if not bool(torch.isfinite(OUTCOMES[kind][0](path)).all()):
            wrong = "not finite"
    except InputError as error:
        line = str(error)
        wrong = "" if len(line.splitlines()) == 1 and line.strip() else f"refused in {len(line.splitlines())} lines"
    except Exception as error:  # anything else is what this test looks for
        wrong = f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - start
    return line, wrong or (f"took {seconds:.0f} s" if seconds > LONGEST else "")


def check(good: Path, kind: str, numbers: range, folder: Path) -> list[Path]:
    """Check mutants of a kind, and return those that are refused."""
    wrong, refused, memory = [], [], peak_memory(torch.device("cpu"))
    for number in numbers:
        path, done = make(good / kind, number, folder)
        line, fault = refusal(path, kind)
        wrong += [f"{kind} mutant {number} ({done}): {fault}"] if fault else []
        refused += [path] if line else []
        if len(numbers) > QUICK:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    grown = peak_memory(torch.device("cpu")) - memory
    assert not wrong, "\n".join(wrong)
    assert grown < MOST_MEMORY or kind in FIELDS, f"{grown / 2**30:.1f} GiB more memory"
    return refused


FIELDS = [kind for kind in OUTCOMES if kind not in IMAGES]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", [*IMAGES, *(pytest.param(kind, marks=pytest.mark.slow) for kind in FIELDS)])
def test_mutants_are_refused_in_one_line_or_give_something_finite(good, kind, tmp_path, capfd):
    assert refusal(good / kind, kind) == ("", "")
    refused = check(good, kind, range(QUICK), tmp_path)
    if not kind.endswith(".dng"):  # LibRaw cannot be kept from it
        assert capfd.readouterr().err == ""  # no library has its own say
    assert refused or kind in IMAGES
    for path in refused[:5] if kind in ("m.nc", "v.vti", "r.zarr") else ():
        assert main(["info", str(path)]) == 2
        assert len(capfd.readouterr().err.splitlines()) == 1


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("kind", "first"), [(kind, first) for kind, (_, count) in OUTCOMES.items() for first in range(0, count, BLOCK)]
)
def test_ten_thousand_mutants(good, kind, first, tmp_path):
    check(good, kind, range(first, min(first + BLOCK, OUTCOMES[kind][1])), tmp_path)


def test_there_are_ten_thousand_of_each():
    for kinds in (IMAGES, FIELDS):
        assert sum(OUTCOMES[kind][1] for kind in kinds) >= 10_000
