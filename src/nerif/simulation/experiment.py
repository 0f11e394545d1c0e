"""A whole rendered experiment: images of targets, background and flow of every view.

nerif calibrate and nerif displacement read its folder (imaging/readers/views.py).
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.files import write_toml
from nerif.common.written_files import WRITTEN, OwnFiles
from nerif.data.cameras_file import CalibratedCamera, write_cameras
from nerif.data.volume import Volume, write_netcdf
from nerif.fields.field import Field
from nerif.geometry import Box, Camera, Grid
from nerif.imaging.calibration.bundle import Pose
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.patterns import Background
from nerif.simulation.experiment_settings import ExperimentSettings
from nerif.simulation.rendering import Texture, background_texture, pattern_size, render

__all__ = ["Experiment", "background_poses", "background_scale", "place", "side_of_one", "target_poses", "world_axes"]

SIDES = {
    (1, 0): ("z-", "x+", "y-"),
    (-1, 0): ("z+", "x-", "y-"),
    (0, 1): ("x-", "z-", "y-"),
    (0, -1): ("x+", "z+", "y-"),
}
"""World axes along the axes of an upright target, by the x and y direction of the world that it faces."""

KINDS = ("target", "background", "reference", "flow")  #: folders of a view

ORIGIN = torch.zeros(3, dtype=torch.float64)


class Experiment(ExperimentSettings):
    """The images of an experiment."""

    def write(
        self, folder: Path, cameras: Sequence[Camera], phantom: Field, box: Box, n_ambient: float,
        truth_voxels: int = 100, on_image: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        """Render VIEW/{target,background,reference,flow}/; write calibrate.toml and truth/{calibration.toml,volume.nc}.

        Raises InputError if a view has images that this program did not write: even under other names they would be
        taken for images of the experiment.

        Parameters
        ----------
        cameras : of the rig, with their lenses
        phantom, box : field of index excess, and its box
        n_ambient : refractive index around it
        truth_voxels : along the longest edge of the box
        on_image : called after each image (`images` of them in total)
        """
        if truth_voxels < 1:
            raise InputError(f"expected at least 1, got {truth_voxels}", field="truth_voxels")
        _check_images(folder, cameras)
        truth = folder / "truth"
        truth.mkdir(parents=True, exist_ok=True)
        with OwnFiles(truth).writing("calibration.toml") as path:
            write_cameras(path, [CalibratedCamera.from_camera(c) for c in cameras], box=box)
        grid = Grid.of_resolution(box, truth_voxels)
        with OwnFiles(truth).writing("volume.nc") as path:
            write_netcdf(path, [Volume(phantom.sample(grid), grid, attributes={"n_ambient": n_ambient})])
        with OwnFiles(folder).writing("calibrate.toml") as path:
            write_toml(path, self._calibration_settings(cameras))
        for i, camera in enumerate(cameras):
            self._background_images(folder / camera.name, camera, i, phantom, box, n_ambient, on_image)
        if self.poses:
            self.write_targets(folder, cameras, on_image)

    def _calibration_settings(self, cameras: Sequence[Camera]) -> dict[str, object]:
        """Settings of nerif calibrate that reproduce the world of the rig."""
        settings: dict[str, object] = {
            "world": "0",
            "axes": world_axes(cameras),
            "background_scale": background_scale(cameras),
            "target": asdict(self.target_for(cameras)),
            **_lens_settings(cameras[0]),
        }
        if any(bool(camera.tilt.any()) for camera in cameras):
            settings["scheimpflug"] = True
        if not cameras[0].projection.shows_depth:
            settings["projection"] = cameras[0].projection.name
            settings["side"] = side_of_one(cameras)
            settings["background_distance"] = -cameras[0].plane.offset
        return settings

    def write_targets(
        self, folder: Path, cameras: Sequence[Camera], on_image: Callable[[], None] = lambda: None
    ) -> None:
        """Render the images of the target into VIEW/{target,background}/."""
        target = self.target_for(cameras)
        on_background = target.scaled(background_scale(cameras))
        for j, pose in enumerate(target_poses(cameras, target, self.poses, self.seed)):
            for camera in cameras:
                if _faces(pose, camera):
                    self._target_image(folder / camera.name / "target" / f"pose_{j:03d}.tif", camera, target, pose)
                on_image()
        for camera in cameras:
            for j, pose in enumerate(background_poses(camera, on_background, self.backgrounds)):
                path = folder / camera.name / "background" / f"laid_{j:03d}.tif"
                self._target_image(path, camera, on_background, pose)
                on_image()

    def target_for(self, cameras: Sequence[Camera]) -> CalibrationTarget:
        """Return the target; without a pitch, of a size that fits the images."""
        pitch = self.pitch
        if pitch == 0:
            fields = (float(c.pixel_size(ORIGIN)) * torch.tensor(c.image_size) for c in cameras)
            pitch = 0.75 * min(min(float(s[1]) / (self.columns + 1), float(s[0]) / (self.rows + 1)) for s in fields)
        return CalibrationTarget(self.target, self.columns, self.rows, pitch)

    def images(self, views: int) -> int:
        """Return the number of images of `views` views, including targets that face away."""
        return views * (self.references + 1 + (self.poses + self.backgrounds if self.poses else 0))

    def _background_images(
        self, folder: Path, camera: Camera, i: int, phantom: Field, box: Box, n_ambient: float,
        on_image: Callable[[], None],
    ) -> None:  # fmt: skip
        width, height = pattern_size(camera)
        pixel = width / 1.1 / camera.image_size[1]
        pattern = Background(self.kind, width, height, dot=self.dot * pixel, seed=1000 * self.seed + i)
        texel = pattern.raster_pixel(0.0)
        texture = background_texture(camera, torch.from_numpy(pattern.raster(texel)), texel)
        still = render(camera, texture, samples=self.samples)
        for k in range(self.references):
            self._save(folder / "reference" / f"reference_{k:03d}.tif", still)
            on_image()
        self._save(folder / "flow" / "flow_000.tif", render(camera, texture, phantom, box, n_ambient, self.samples))
        on_image()

    def _target_image(self, path: Path, camera: Camera, target: CalibrationTarget, pose: Pose) -> None:
        self._save(path, render(replace(camera, lens=None), place(target, pose, camera), samples=self.samples))

    def _save(self, path: Path, light: Float[Tensor, "row column"]) -> None:
        import tifffile

        path.parent.mkdir(parents=True, exist_ok=True)
        seed = zlib.crc32("/".join(path.parts[-3:]).encode()) + self.seed  # the same images in any folder and order
        counts = self.sensor.expose(light, seed)
        tags = [(281, "H", 1, 2**self.sensor.bits - 1, False)]  # MaxSampleValue: the bits used out of 16
        with OwnFiles(path.parent).writing(path.name):
            tifffile.imwrite(path, counts, extratags=tags)


def _check_images(folder: Path, cameras: Sequence[Camera]) -> None:
    for images in (folder / camera.name / kind for camera in cameras for kind in KINDS):
        files = OwnFiles(images)
        foreign = [p.name for p in sorted(images.glob("*")) if p.name != WRITTEN and p.name not in files]
        if foreign:
            raise InputError(
                f"contains {foreign[0]}, which nerif render did not write; unchanged, give another --out", field=images
            )


def _lens_settings(camera: Camera) -> dict[str, float]:
    """Options of nerif calibrate for the lens; its telecentric cameras have z_cam = 0 at the origin."""
    if camera.lens is None or camera.lens.diameter == 0:
        return {}
    diameter, focus = camera.lens.diameter, camera.lens.focus
    if not camera.projection.shows_depth:
        depth, origin = focus or camera.depth(camera.plane), float(camera.local(ORIGIN)[2])
        diameter, focus = diameter * abs(1 - origin / depth), None if focus is None else focus - origin
    return {"aperture_diameter": diameter, **({} if focus is None else {"focus_distance": focus})}


def background_scale(cameras: Sequence[Camera]) -> float:
    """Return the scale of the target on the backgrounds that gives it the image size of the target at the origin."""
    middle = [torch.tensor([[(n - 1) / 2 for n in c.image_size[::-1]]], dtype=torch.float64) for c in cameras]
    ends = [c.rays(m).end_points[0] for c, m in zip(cameras, middle, strict=True)]
    ratios = [float(c.pixel_size(end) / c.pixel_size(ORIGIN)) for c, end in zip(cameras, ends, strict=True)]
    return round(min(ratios), 1)


def world_axes(cameras: Sequence[Camera]) -> tuple[str, str, str]:
    """Return the world axes (option of nerif calibrate) along the axes of the first target pose."""
    return SIDES[_side(cameras)]


def side_of_one(cameras: Sequence[Camera]) -> tuple[str, str]:
    """Return the view farthest to one side of the first target pose, and that side of the world."""
    across = (_side(cameras)[0] == 0, _side(cameras)[1] == 0)  # x or y
    places = [-c.sight(ORIGIN)[:2] @ torch.tensor(across, dtype=torch.float64) for c in cameras]
    i = max(range(len(cameras)), key=lambda k: abs(float(places[k])))
    return cameras[i].name, f"{'x' if across[0] else 'y'}{'+' if float(places[i]) > 0 else '-'}"


def _side(cameras: Sequence[Camera]) -> tuple[int, int]:
    """The horizontal axis of the world that points most towards the middle camera."""
    x, y, _ = (-cameras[len(cameras) // 2].sight(ORIGIN)).tolist()
    if abs(x) > abs(y):
        return (1 if x > 0 else -1, 0)
    return (0, 1 if y > 0 else -1)


def target_poses(cameras: Sequence[Camera], target: CalibrationTarget, count: int, seed: int) -> list[Pose]:
    """Return poses (target to world) around the origin, facing the cameras; the first one is upright.

    The others face between two neighbouring cameras, tilted by up to 35 degrees and shifted by up to a tenth of the
    target's size, so that several cameras see each.
    """
    from scipy.spatial.transform import Rotation

    if count < 4:
        raise InputError(f"expected 4 target poses or more, got {count}", field="poses")
    rng = np.random.default_rng(seed)
    directions = np.stack([-c.sight(ORIGIN).numpy() for c in cameras])
    poses = [Pose(_facing(np.array([*_side(cameras), 0.0])), np.zeros(3))]
    for k in range(count - 1):
        at = (k + rng.random()) / (count - 1) * (len(cameras) - 1)
        i = min(int(at), max(len(cameras) - 2, 0))
        j = min(i + 1, len(cameras) - 1)
        direction = (1 - (at - i)) * directions[i] + (at - i) * directions[j]
        tilt = Rotation.from_euler("xyz", rng.uniform(-35, 35, 3), degrees=True).as_matrix()
        shift = 0.1 * max(target.size) * rng.uniform(-1, 1, 3)
        poses.append(Pose(_facing(direction / np.linalg.norm(direction)) @ tilt, shift))
    return poses


def background_poses(camera: Camera, target: CalibrationTarget, count: int) -> list[Pose]:
    """Return poses of the target on a camera's background: in the middle, then towards the corners."""
    from scipy.spatial.transform import Rotation

    middle = background_texture(camera, torch.zeros(2, 2, dtype=torch.float64), 1.0)
    frame = torch.stack([middle.right, middle.down, torch.linalg.cross(middle.right, middle.down)], dim=1).numpy()
    centre = (middle.corner + middle.right + middle.down).numpy()
    width, height = (s / 2.2 for s in pattern_size(camera))  # half of the image
    room = np.maximum(0.9 * np.array([width, height]) - np.array(target.size) / 2, 0)
    corners = [(0, 0), (-1, -1), (1, 1), (1, -1), (-1, 1), (0, -1), (0, 1), (-1, 0), (1, 0)]
    poses = []
    for k in range(count):
        across, down = room * corners[k % len(corners)]
        turn = Rotation.from_euler("z", 8 * (k % 3 - 1), degrees=True).as_matrix()
        poses.append(Pose(frame @ turn, centre + across * frame[:, 0] + down * frame[:, 1]))
    return poses


def place(target: CalibrationTarget, pose: Pose, camera: Camera) -> Texture:
    """Return a target in space as a texture that is fine enough for a camera."""
    centre = torch.from_numpy(pose.translation)
    fine = float(camera.pixel_size(centre)) / 3  # as the points of a pixel: finer edges would alias
    right, down = (torch.from_numpy(pose.rotation[:, k].copy()) for k in range(2))
    return Texture.around(centre, right, down, torch.from_numpy(target.raster(fine)), target.raster_pixel(fine))


def _facing(direction: np.ndarray) -> np.ndarray:
    """Rotation of an upright target that faces a direction."""
    z = -direction
    x = np.cross([0.0, 0.0, -1.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _faces(pose: Pose, camera: Camera) -> bool:
    """Whether a camera sees the front of a target at less than 55 degrees."""
    sight = camera.sight(torch.from_numpy(pose.translation)).numpy()
    return bool(pose.rotation[:, 2] @ sight > np.cos(np.radians(55)))
