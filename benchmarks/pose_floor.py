"""What may be expected of a refined rig at best, of rigs whose cameras stand elsewhere than their file says.

    python benchmarks/pose_floor.py ../shared/data/rigs --write benchmarks/results/pose-floor-cpu.md

No camera sees a shift of all of them with the field; only their priors hold it, at the weighted mean of their errors:

    b = argmin sum_v (a_v + A_v b)^T C_v^-1 (a_v + A_v b)

with a_v by how many pixels view v shows the middle of the box elsewhere than it is stated to, A_v what a shift changes
of that, and C_v the covariance that the file states of it. So a reconstruction that is right in all else finds the
field moved by b, and the first row of each rig is the L2 of the truth so moved. The box is not moved with it, and the
flame ends at its faces; the other rows are NeRIF's with cameras fitted to the truth, where they are and moved by b.
These cameras have seen the truth: they tell what may be expected, and no reconstruction starts from them.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench import Table, add_write, alone
from nerif.analysis.alignment import MovedField
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.data.volume_file import read_volume
from nerif.fields.grid import VoxelField
from nerif.geometry import Camera
from nerif.reconstruction.rig.refinement import Refinement, refit

RIGS = ("pose_small", "pose_large")
PIXELS, ROUNDS = 3000, 10  # of a view, and steps, to fit cameras to the truth


def fitted(measurement: Measurement, truth: Volume) -> tuple[Camera, ...]:
    """Return the cameras that fit a field best which is known."""
    settings: dict[str, Any] = {"refine": ("cameras",), "open_faces": ()}
    settings |= {"pose_sigma_mm": None, "pose_sigma_deg": None, "shift_sigma_px": 0.05}
    field = VoxelField.through(truth.values.double(), truth.grid)
    table = refit(field, measurement, settings, steps=ROUNDS, per_view=PIXELS)
    return Refinement.of_table(measurement, settings, table, gauged=False).corrected


def untold(measurement: Measurement, true: tuple[Camera, ...]) -> Tensor:
    """Return b, the shift of everything that the priors leave, mm."""
    rig = Refinement.for_measurement(measurement, ("cameras",))
    middle = torch.tensor([measurement.box.centre], dtype=torch.float64)
    curvature, pull = torch.zeros(3, 3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    for v, (stated, camera) in enumerate(zip(measurement.cameras, true, strict=True)):
        look = rig.aside(v)
        of_shift = look[:, 3:6] @ stated.rotation.double()
        inverse = torch.linalg.inv((look * rig.sigma[v, rig.columns] ** 2) @ look.T)
        aside = (camera.project(middle) - stated.project(middle))[0].double()
        curvature += of_shift.T @ inverse @ of_shift
        pull -= of_shift.T @ inverse @ aside
    return torch.linalg.solve(curvature, pull)


def shifted(camera: Camera, b: Tensor) -> Camera:
    """Return a camera that stands elsewhere by b, looking at the same background."""
    return replace(camera, translation=camera.translation - camera.rotation @ b.to(camera.rotation))


def run(path: Path, cameras: tuple[Camera, ...], steps: int, seed: int) -> tuple[float, float]:
    """Reconstruct with cameras of these poses; return L2 before and after the best rigid motion."""
    from nerif.analysis.alignment import aligned
    from nerif.analysis.evaluation import evaluate_volume
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural.neural import NeRIF

    keep_freed_memory()
    measurement, truth = Measurement.read(path), read_volume(path.with_name("truth.nc"))
    settings = NeRIF(max_steps=steps, epochs=1e9, seed=seed, device="cpu")
    field = settings(replace(measurement, cameras=cameras)).field
    found = [evaluate_volume(f, truth, measurement.n_ambient)["l2"] for f in (field, aligned(field, truth))]
    return found[0], found[1]


def main() -> None:
    """Run and print the table."""
    from nerif.analysis.evaluation import evaluate_volume

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("rigs", type=Path, help="folder with the measurement files and truth.nc")
    parser.add_argument("--only", nargs="+", default=list(RIGS), help="some of the rigs")
    parser.add_argument("--steps", type=int, default=2000, help="of training; some 90 s on two cores")
    parser.add_argument("--seed", type=int, default=0)
    add_write(parser)
    asked = parser.parse_args()
    table = Table("What may be expected of a refined rig at best", ["rig", "field", "L2", "L2 aligned"], asked.write)
    truth = read_volume(asked.rigs / "truth.nc")
    field = VoxelField.through(truth.values.double(), truth.grid)
    for name in asked.only:
        path = asked.rigs / f"{name}.nc"
        measurement = Measurement.read(path)
        true = fitted(measurement, truth)
        b = untold(measurement, true)
        moved = MovedField(field, torch.zeros(3, dtype=torch.float64), -b)
        l2 = evaluate_volume(moved, truth, measurement.n_ambient)["l2"]
        by = "({:.2f}, {:.2f}, {:.2f})".format(*b.tolist())
        table.row([name, f"truth, moved by {by} mm", f"{l2:.3%}", ""])
        ways = {"true cameras": true, "true cameras, moved so": tuple(shifted(c, b) for c in true)}
        for words, cameras in ways.items():
            found = alone(run, path, cameras, asked.steps, asked.seed)
            table.row([name, f"NeRIF, {words}", *(f"{error:.3%}" for error in found)])


if __name__ == "__main__":
    main()
