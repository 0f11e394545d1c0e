"""Outlines of bodies in the views: the pose of a known body, and the visual hull of an unknown one.

The ray of a point on the outline touches the body, so its least signed distance from the surface is 0. With the body at
exp([w]x) (x - c) + c + t, that of ray i changes by

    dr_i = -n_i . t - ((x_i - c) x n_i) . w

where n_i is the outward normal at the point x_i of the ray that is nearest to the body, or deepest in it. The pose
minimises the squares of r_i over its noise, with a weak prior on w and t, by Gauss-Newton steps. Its covariance is
that of errors which are the same all along a part of an outline, as pixels round a straight edge.

    cov = A^-1 (sum_part g g^T + P) A^-1,      g = sum J^T / noise,      A = J^T J / noise^2 + P

Source: Liang & Zeger, Biometrika 73 (1986) 13, for errors that are correlated within groups.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerif.common.arrays import Matrix3, Points, Values
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.geometry import Camera, Grid, Rays
from nerif.geometry.body import Body
from nerif.geometry.pose import rotation_matrix
from nerif.imaging.readers.open import read_mask

__all__ = ["BodyPose", "drawn_silhouettes", "hull_of_silhouettes", "outline", "refine_pose"]

PRIOR = (0.05, 0.05)  # rad; of the longest edge of the box
UNKNOWN = 0.4  # of the standard deviation of the prior, above which the outlines say nothing of a direction
QUANTISED = 0.29  # px: an outline lies anywhere between two pixel centres
GATES = (12.0, 12.0, 8.0, 5.0, 3.0, 3.0, 3.0, 2.0, 2.0, 2.0)  # px: points of the outline farther away do not count
FEWEST = 20  # points of the outline
ALONG, ZOOMS, CLOSER = 40, 3, 7  # places along a ray; refinements of the nearest one, and their places
PARTS = 8  # of an outline, whose errors are independent
HULL_VOXELS = 96


@dataclass(frozen=True)
class BodyPose:
    """A refined pose, and how well it is known."""

    body: Body  #: there
    rotation: Matrix3  #: (3, 3) R and
    translation: Float[Tensor, 3]  #: (3,) t of x' = R x + t, from where it was, mm
    turn: Float[Tensor, 3]  #: (3,) of the body about its centre, rad
    shift: Float[Tensor, 3]  #: (3,) of its centre, mm
    sigma: Float[Tensor, 6]  #: (6,) standard deviations of turn (rad) and shift (mm)
    unknown: tuple[str, ...]
    """Turns about x, y, z and shifts along x, y, z of which the outlines say little, such as a turn of a cone about
    its axis."""
    residual: float  #: rms distance of the outline, px
    points: int  #: of the outline

    @property
    def sentence(self) -> str:
        """The pose as a line of text."""

        def values(numbers: Tensor, sigma: Tensor, unit: str) -> str:
            pairs = zip(numbers.tolist(), sigma.tolist(), strict=True)
            return ", ".join(f"{value:.3g} +- {error:.1g}" for value, error in pairs) + f" {unit}"

        turn = values(self.turn.rad2deg(), self.sigma[:3].rad2deg(), "deg")
        unknown = f"; not determined: {', '.join(self.unknown)}" if self.unknown else ""
        return (
            f"{self.body.name}: turned by {turn} about x, y, z, shifted by {values(self.shift, self.sigma[3:], 'mm')}; "
            f"{self.points} points of its outline, rms {self.residual:.2f} px{unknown}"
        )


def drawn_silhouettes(drawings: Mapping[str, Path], measurement: Measurement) -> Bool[Tensor, "view row column"]:
    """Return the silhouettes of images by the names of views (white: body); a view without one has none."""
    masks = torch.zeros(measurement.shape, dtype=torch.bool)
    for i, (name, camera) in enumerate(zip(measurement.names, measurement.cameras, strict=True)):
        if name in drawings:
            height, width = camera.image_size
            masks[i, :height, :width] = torch.from_numpy(read_mask(drawings[name], camera.image_size))
    return masks


def outline(mask: Bool[Tensor, "row column"]) -> Float[Tensor, "n 2"]:
    """Return the points (px) halfway between neighbours of which one is in a mask."""
    across, along = (mask[:, 1:] ^ mask[:, :-1]).nonzero(), (mask[1:] ^ mask[:-1]).nonzero()
    columns = torch.stack([across[:, 1] + 0.5, across[:, 0].double()], dim=1)
    rows = torch.stack([along[:, 1].double(), along[:, 0] + 0.5], dim=1)
    return torch.cat([columns, rows])


def refine_pose(
    measurement: Measurement, body: Body, silhouettes: Bool[Tensor, "view row column"] | None = None, margin: float = 0
) -> BodyPose:
    """Return the pose of a body that fits its silhouettes.

    Parameters
    ----------
    body : near its pose, to about ten pixels
    silhouettes : default: the pixels without data
    margin : pixels by which the silhouettes are larger than the body

    Raises InputError if there are no silhouettes, or too few points of an outline are near the body.
    """
    where = "pixels without data" if silhouettes is None else "silhouettes"
    masks = ~measurement.usable if silhouettes is None else silhouettes  # pixels without data show bodies
    if not bool(masks.any()):
        raise InputError(f"--refine needs {where} where the body is, got none", field=body.name)
    rays, pixel = _outlines(measurement, masks)
    prior = torch.tensor([PRIOR[0]] * 3 + [PRIOR[1] * max(measurement.box.edges)] * 3, dtype=torch.float64)
    centre = body.vertices.mean(dim=0)
    pose = torch.zeros(6, dtype=torch.float64)
    for gate in GATES:
        moved = body.moved(*_transform(body, pose))
        distance, points, normals = _least_distance(moved, rays)
        residual = distance / pixel - margin
        near = residual.abs() < gate
        if int(near.sum()) < FEWEST:
            raise InputError(
                f"--refine needs {where} where the body is, got {int(near.sum())} points of their outline within "
                f"{gate:g} px of its own; check its place",
                field=body.name,
            )
        arm = points - centre - pose[3:]
        slope = -torch.cat([torch.linalg.cross(arm, normals), normals], dim=1)[near] / pixel[near, None]
        noise = max(float(residual[near].square().mean().sqrt()), QUANTISED)
        information = slope.T @ slope / noise**2 + torch.diag(prior**-2)
        gradient = slope.T @ residual[near] / noise**2 + pose / prior**2
        pose = pose - torch.linalg.solve(information, gradient)
    part = _parts(rays, near)
    pull = torch.zeros(int(part.max()) + 1, 6, dtype=torch.float64)
    pull.index_add_(0, part, slope / noise)
    inverse = torch.linalg.inv(information)
    covariance = inverse @ (pull.T @ pull + torch.diag(prior**-2)) @ inverse
    sigma = covariance.diagonal().sqrt()
    axes = [f"{kind} {axis}" for kind in ("turn about", "shift along") for axis in "xyz"]
    rotation, translation = _transform(body, pose)
    return BodyPose(
        body.moved(rotation, translation), rotation, translation, pose[:3], pose[3:], sigma,
        _unknown(covariance, prior, axes), float(residual[near].square().mean().sqrt()), int(near.sum()),
    )  # fmt: skip


def _parts(rays: Rays, near: Bool[Tensor, " n"]) -> Int[Tensor, " m"]:
    """The part of an outline to which each of the near points belongs: errors along a straight edge are the same."""
    view, pixel = rays.view.long()[near], rays.pixel.double()[near]
    middle = torch.zeros(int(view.max()) + 1, 2, dtype=torch.float64)
    count = torch.bincount(view, minlength=len(middle)).clamp_min(1)
    middle = middle.index_add(0, view, pixel) / count[:, None]
    across, along = (pixel - middle[view]).unbind(-1)
    octant = ((torch.atan2(along, across) / math.pi + 1) * PARTS / 2).long().clamp(0, PARTS - 1)
    return view * PARTS + octant


def _unknown(covariance: Float[Tensor, "6 6"], prior: Float[Tensor, 6], names: list[str]) -> tuple[str, ...]:
    """The names of the parameters that carry most of each direction that is known no better than before."""
    share, directions = torch.linalg.eigh(covariance / prior[:, None] / prior)
    loose = [directions[:, i].abs() for i in range(6) if float(share[i]) > UNKNOWN**2]
    return tuple(dict.fromkeys(names[int(direction.argmax())] for direction in loose))


def _transform(body: Body, pose: Float[Tensor, 6]) -> tuple[Matrix3, Float[Tensor, 3]]:
    """R and t of a turn about the centre of a body and a shift."""
    centre, rotation = body.vertices.mean(dim=0), rotation_matrix(pose[:3])
    return rotation, centre + pose[3:] - rotation @ centre


def _outlines(measurement: Measurement, masks: Bool[Tensor, "view row column"]) -> tuple[Rays, Values]:
    """The rays of all points of the outlines, and the width of a pixel at the centre of the box, mm."""
    parts, widths = [], []
    for i, (camera, width) in enumerate(zip(measurement.cameras, measurement.pixel_sizes, strict=True)):
        rows, columns = camera.image_size
        pixels = outline(masks[i, :rows, :columns]).to(camera.intrinsics.dtype)
        parts.append(camera.rays(pixels, sensitivity=False, view=i))
        widths.append(torch.full((len(pixels),), width, dtype=torch.float64))
    return Rays.concatenate(parts), torch.cat(widths)


def _least_distance(body: Body, rays: Rays) -> tuple[Values, Points, Points]:
    """The least signed distance of each ray from the surface (mm), the point of the ray there, and the normal."""
    lower, upper = body.extent
    centre, half = (lower + upper) / 2, float((upper - lower).norm()) / 2
    origin, direction = rays.origin.double(), rays.direction.double()
    middle, step = ((centre - origin) * direction).sum(dim=-1), 2 * half / ALONG
    places = middle[:, None] + torch.linspace(-half, half, ALONG + 1, dtype=torch.float64)
    for _ in range(ZOOMS):
        distance = body.distance(origin[:, None] + places[..., None] * direction[:, None])
        best = places.gather(1, distance.argmin(dim=1, keepdim=True))
        places = best + torch.linspace(-step, step, CLOSER, dtype=torch.float64)
        step = 2 * step / (CLOSER - 1)
    points = origin + best * direction
    where, face = body.closest(points)
    least = body.distance(points)
    outwards = (points - where) / least[:, None]
    normals = torch.where((least.abs() > 1e-6)[:, None], outwards, body.normals[face])
    return least, points, normals


def hull_of_silhouettes(
    measurement: Measurement, silhouettes: Bool[Tensor, "view row column"], voxels: int = HULL_VOXELS
) -> Body:
    """Return the largest body that hides nothing outside its silhouettes: their visual hull within the box."""
    from skimage.measure import marching_cubes

    grid = Grid.of_resolution(measurement.box, voxels)
    points = grid.points(torch.float64).reshape(-1, 3)
    inside = torch.ones(len(points), dtype=torch.float64)
    visible = torch.zeros(len(points), dtype=torch.bool)
    for camera, mask in zip(measurement.cameras, silhouettes, strict=True):
        if bool(mask.any()):
            share, in_image = _share(camera, mask, points)
            inside, visible = torch.where(in_image, torch.minimum(inside, share), inside), visible | in_image
    values = torch.where(visible, inside, 0.0).reshape(grid.shape).numpy()
    if not (values > 0.5).any():
        raise InputError(
            "the silhouettes have no point of the box in common; are they of this rig, white on the body?",
            field="silhouettes",
        )
    corners, faces, _, _ = marching_cubes(np.pad(values, 1), 0.5)
    first = np.array([float(grid.axis(axis)[0]) for axis in "xyz"])
    vertices = (corners[:, ::-1] - 1) * np.array(grid.spacing) + first
    return Body(torch.from_numpy(np.ascontiguousarray(vertices)), torch.from_numpy(faces.astype(np.int64)), "hull")


def _share(camera: Camera, mask: Bool[Tensor, "row column"], points: Points) -> tuple[Values, Bool[Tensor, " n"]]:
    """The mask at the images of points, between pixels linearly, and which are in the image."""
    height, width = camera.image_size
    u, v = camera.project(points).unbind(-1)
    in_image = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
    scaled = torch.stack([2 * (u + 0.5) / width - 1, 2 * (v + 0.5) / height - 1], dim=-1).nan_to_num(2.0)
    image = mask[None, None, :height, :width].double()
    share = torch.nn.functional.grid_sample(image, scaled[None, None], padding_mode="border", align_corners=False)
    return share[0, 0, 0], in_image
