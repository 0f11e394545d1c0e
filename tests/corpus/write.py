"""Write an archive of small files of every kind by the present version: python tests/corpus/write.py VERSION.tar.gz.

Once per released version; tests/corpus/test_corpus.py reads all archives, so that files outlive versions.
"""

from __future__ import annotations

import json
import os
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

import torch

import nerif
from nerif.app.project.folder import OWN, ProjectFolder
from nerif.app.project.workspace import Workspace
from nerif.cli.cli import main
from nerif.data.cameras_file import CalibratedCamera, write_cameras
from nerif.fields.network_shape import NetworkShape
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.field_files import CHECKPOINT

POINTS = [[0.0, 0.0, 0.0], [3.0, -2.0, 4.0], [-6.0, 5.0, -3.0]]  # mm
PROJECT: dict[str, Any] = {
    "design": {"views": 5}, "at_once": 2, "run": ["reconstruct", "m.nc", "--out", "results/r", "--live"],
}  # fmt: skip
RESULTS = {
    "voxels": nerif.Tikhonov(voxels=8, device="cpu", regularisation=1e-2),
    "neural": nerif.preset("fast", max_steps=3, device="cpu", network=NetworkShape(depth=2, width=8, octaves=2)),
    "detail": nerif.TotalVariation(voxels=8, device="cpu", regularisation=1e-2),
    "symmetric": nerif.Tikhonov(voxels=8, device="cpu", regularisation=1e-2, symmetry="axis"),
}


def write(folder: Path) -> None:
    """Write the files and expected.json with what they hold."""
    box = Box.around_origin((20.0, 18.0, 16.0))
    flame = nerif.make_phantom("flame", box, seed=1)
    ring = Ring(views=4, arc=(0.0, 135.0), image_size=(12, 14), pixel_pitch=0.2)
    plain = nerif.simulate(flame, ring.cameras(), box, 1.00027, noise=0.05, seed=1, steps=30)
    plain.write(folder / "measurement-1.0.nc")
    lens = nerif.simulate(flame, ring.cameras(8.0), box, 1.00027, noise=0.05, seed=1, steps=30)
    lens.write(folder / "measurement-1.1.nc")
    write_cameras(folder / "calibration.toml", [CalibratedCamera.from_camera(c) for c in plain.cameras])
    grid = Grid(box, (4, 5, 6))
    nerif.Volume.of(flame.sample(grid), grid, "index_excess", 1.00027).write(folder / "volume.vti")
    for name, method in RESULTS.items():
        detail = "on" if name == "detail" else "off"
        run = nerif.RunSettings(report=False, withhold=("none",), detail=detail)
        nerif.reconstruct_into(folder / name, plain, method, run, voxels=8 if name == "neural" else None)
        (folder / name / CHECKPOINT).unlink()
    film, small = f"{folder}/film.zarr", "--network.depth 2 --network.width 8 --voxels 8"
    rig = "--box 20 18 16 --views 4 --image-size 12 14 --pixel-pitch 0.2"
    assert main(f"simulate --steps 30 --truth-voxels 8 --times 0:0.01:2 {rig} -o {film}".split()) == 0
    assert main(f"sequence {film} -o {folder}/film_result.zarr --max-steps 3 {small}".split()) == 0
    expected = {name: nerif.ResultDirectory(folder / name).field()[0](POINTS).tolist() for name in RESULTS}
    measurements = {"1.0": plain, "1.1": lens}
    rms = {name: float(m.displacements.nan_to_num().square().mean().sqrt()) for name, m in measurements.items()}
    about = {"nerif": nerif.__version__, "points": POINTS, "fields": expected, "rms": rms, "project": PROJECT}
    write_project(folder / "project", folder / "measurement-1.0.nc")
    (folder / "expected.json").write_text(json.dumps(about, indent=1))


def write_project(folder: Path, measurement: Path) -> None:
    """Write what nerif app keeps in the folder of a project: drafts of the pages, runs, findings of a check."""
    folder.mkdir()
    workspace = Workspace(ProjectFolder(folder))
    workspace.keep("design", PROJECT["design"])
    workspace.jobs.at_once = PROJECT["at_once"]
    workspace.jobs.add(PROJECT["run"], "a run", "results/r")
    checks = folder / OWN / "checks"
    checks.mkdir()
    assert main(["check", str(measurement), "--voxels", "8", "--findings", str(checks / "m.json")]) == 0


if __name__ == "__main__":
    torch.manual_seed(0)
    os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp()  # the key that signs the runs of a project
    with tempfile.TemporaryDirectory() as temporary:
        write(Path(temporary))
        with tarfile.open(sys.argv[1], "w:gz") as archive:
            archive.add(temporary, ".")
