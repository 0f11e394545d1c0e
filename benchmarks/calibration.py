"""How well a rig is found from target images alone: nine rendered cameras with mild distortion, none quite in place.

    python benchmarks/calibration.py --write benchmarks/results/calibration.md

The rig: 640 x 512 px, lens of 50 mm on a 20 mm sensor, 700 mm to the middle, backgrounds 500 mm behind it; each
camera is turned by about a degree, moved by some mm, its principal point off by some px, its background oblique.
Errors are taken against the rig rendered: angle of rotation, largest component of the translation, largest distance
between the planes anywhere in the image. `stated` is what nerif calibrate itself says of rotation and position.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bench import Table, add_write
from nerif.geometry import Camera, Plane, Ring
from nerif.imaging.calibration.calibrate import CalibrationSettings, calibrate
from nerif.imaging.calibration.target_images import find_targets
from nerif.imaging.readers.views import find_views
from nerif.simulation.experiment import Experiment, background_scale, world_axes

COLUMNS = ("camera", "images", "rms [px]", "rotation [deg]", "stated", "translation [mm]", "stated", "position [mm]",
           "plane [mm]", "plane, rms [mm]")  # fmt: skip


def rig(views: int, arc: float, pixels: int, sensor: float, seed: int) -> tuple[Camera, ...]:
    """Cameras on a ring, none quite where it should be."""
    rng = np.random.default_rng(seed)
    ring = Ring(views=views, arc=(0.0, arc), pixel_pitch=sensor / pixels, image_size=(pixels * 4 // 5, pixels))

    def turn(sigma: float) -> torch.Tensor:
        return torch.from_numpy(Rotation.from_rotvec(rng.normal(0, sigma, 3)).as_matrix())

    cameras = []
    for camera in ring.cameras():
        rotation = turn(0.01) @ camera.rotation
        k = camera.intrinsics.clone()
        k[0, 2] += rng.normal(0, 0.005 * pixels)
        k[1, 2] += rng.normal(0, 0.005 * pixels)
        k[0, 0] *= 1 + rng.normal(0, 0.01)
        k[1, 1] = k[0, 0] * (1 + rng.normal(0, 0.001))
        cameras.append(
            replace(
                camera,
                rotation=rotation,
                translation=-rotation @ (camera.centre + torch.from_numpy(rng.normal(0, 5, 3))),
                intrinsics=k,
                background=Plane(turn(0.03) @ camera.plane.normal, -500.0 + float(rng.normal(0, 5))),
                distortion=torch.tensor([-0.15, 0.1, 0.0005, -0.0004, 0.0], dtype=torch.float64),
            )
        )
    return tuple(cameras)


def between_planes(camera: Camera, normal: np.ndarray, offset: float) -> np.ndarray:
    """Distance (mm) of a plane from the true background where the camera sees it."""
    height, width = camera.image_size
    pixels = torch.cartesian_prod(torch.linspace(0, width - 1, 9), torch.linspace(0, height - 1, 9)).double()
    rays = camera.rays(pixels)
    points = rays.end_points.numpy()
    return points @ normal - offset


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--views", type=int, default=9)
    parser.add_argument("--arc", type=float, default=170.0, help="from the first camera to the last, degrees")
    parser.add_argument("--pixels", type=int, default=640, help="width of the images")
    parser.add_argument("--sensor", type=float, default=20.0, help="width of the sensor, mm")
    parser.add_argument("--poses", type=int, default=40, help="target poses free in space")
    parser.add_argument("--backgrounds", type=int, default=5, help="images of the target on each background")
    parser.add_argument("--target", default="charuco")
    parser.add_argument("--seed", type=int, default=0)
    add_write(parser)
    arguments = parser.parse_args()

    cameras = rig(arguments.views, arguments.arc, arguments.pixels, arguments.sensor, arguments.seed)
    experiment = Experiment(
        target=arguments.target, columns=12, rows=9, poses=arguments.poses, backgrounds=arguments.backgrounds,
        references=1, seed=arguments.seed,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        experiment.write_targets(Path(folder), cameras)
        rendered = time.perf_counter() - start
        start = time.perf_counter()
        target = experiment.target_for(cameras)
        laid = target.scaled(background_scale(cameras))
        views = find_views(Path(folder))
        found = [find_targets(view, target, print, on_background=laid) for view in views]
        detected = time.perf_counter() - start
        start = time.perf_counter()
        result = calibrate(found, CalibrationSettings(world="0", axes=world_axes(cameras)))
        adjusted = time.perf_counter() - start
    table = Table(
        "Calibration of a rendered rig",
        COLUMNS,
        arguments.write,
        f"; {target.kind} of {target.columns} x {target.rows}, pitch {target.pitch:.1f} mm; rendered in "
        f"{rendered:.0f} s, targets found in {detected:.0f} s, adjusted in {adjusted:.0f} s; rms {result.rms():.4f} px",
    )
    worst = np.zeros(3)
    by_name = {c.name: c for c in cameras}
    for i, name in enumerate(result.names):
        camera, pose, plane = by_name[name], result.poses[i], result.backgrounds[i]
        rotation = np.degrees(Rotation.from_matrix(pose.rotation @ camera.rotation.numpy().T).magnitude())
        translation = np.abs(pose.translation - camera.translation.numpy()).max()
        position = np.linalg.norm(pose.inverse.translation - camera.centre.numpy())
        assert plane is not None
        off = between_planes(camera, np.array(plane.normal), plane.offset)
        worst = np.maximum(worst, (rotation, translation, np.abs(off).max()))
        used = sum(e.used for e in result.errors if e.camera == name)
        cells = [name, str(used), f"{result.rms(name):.4f}", f"{rotation:.4f}", f"{result.sigma_rotation[i]:.4f}"]
        cells += [f"{translation:.3f}", f"{result.sigma_translation[i]:.3f}", f"{position:.3f}"]
        table.row([*cells, f"{np.abs(off).max():.3f}", f"{np.sqrt((off**2).mean()):.3f}"])
    table.text("", f"Worst: rotation {worst[0]:.4f} deg, translation {worst[1]:.3f} mm, plane {worst[2]:.3f} mm.")


if __name__ == "__main__":
    main()
