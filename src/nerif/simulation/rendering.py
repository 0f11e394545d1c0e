"""Images that a camera would take: a textured plane seen through a field by curved rays, lens disc, pixels and noise.

A pixel averages over its area and over the lens. Each ray is bent by the field and meets the plane at X; the image
is the mean of the texture at X. Without a field the same rays run straight: the reference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError, Points
from nerif.fields.base import Field
from nerif.forward.ray_tracing import trace
from nerif.geometry import Box, Camera, Lens, Plane, Rays
from nerif.simulation.simulate import STEPS

__all__ = ["Sensor", "Texture", "background_texture", "render"]


@dataclass(frozen=True)
class Texture:
    """A printed plane in space.

    Parameters
    ----------
    values : (row, column) reflectance, 0 to 1
    texel : edge of a texel, mm
    corner : (3,) outer corner of the first texel, mm, world frame
    right, down : (3,) unit vectors along columns and rows
    surround : reflectance beyond the edges
    """

    values: Float[Tensor, "row column"]
    texel: float
    corner: Float[Tensor, 3]
    right: Float[Tensor, 3]
    down: Float[Tensor, 3]
    surround: float = 0.5

    @property
    def plane(self) -> Plane:
        """The plane it lies on."""
        normal = torch.linalg.cross(self.right, self.down)
        return Plane(normal, float(normal @ self.corner))

    def at(self, points: Points) -> Float[Tensor, "*batch"]:
        """Return the reflectance at points (mm) of the plane, linear between texel centres."""
        relative = (points - self.corner) / self.texel
        column, row = relative @ self.right, relative @ self.down
        height, width = self.values.shape
        grid = torch.stack([2 * column / width - 1, 2 * row / height - 1], dim=-1)
        flat = torch.nn.functional.grid_sample(
            (self.values - self.surround)[None, None].to(grid), grid.reshape(1, 1, -1, 2), align_corners=False
        )
        return flat.reshape(column.shape) + self.surround


@dataclass(frozen=True)
class Sensor:
    """A sensor: photons to counts.

    Parameters
    ----------
    bits : of the counts, 8 to 16
    exposure : share of full scale that white paper reaches
    full_well : electrons at full scale; shot noise is its Poisson noise. 0 is no shot noise
    read_noise : standard deviation, electrons
    """

    bits: int = 12
    exposure: float = 0.8
    full_well: float = 10000.0
    read_noise: float = 10.0

    def __post_init__(self) -> None:
        if not 8 <= self.bits <= 16:
            raise InputError(f"expected 8 to 16, got {self.bits}", field="bits")
        if not self.exposure > 0 or not self.full_well >= 0 or not self.read_noise >= 0:
            raise InputError("expected exposure > 0, full_well >= 0 and read_noise >= 0", field="sensor")

    def expose(self, light: Float[Tensor, "row column"], seed: int) -> np.ndarray:
        """Return counts of light from 0 (black) to 1 (white paper): shot noise, read noise, rounding, saturation."""
        rng = np.random.default_rng(seed)
        share = self.exposure * light.clamp_min(0).numpy()
        if self.full_well > 0:
            share = (rng.poisson(share * self.full_well) + self.read_noise * rng.standard_normal(share.shape)) / (
                self.full_well
            )
        counts = np.clip(np.round(share * (2**self.bits - 1)), 0, 2**self.bits - 1)
        return counts.astype(np.uint8 if self.bits == 8 else np.uint16)


def background_texture(camera: Camera, values: Float[Tensor, "row column"], texel: float) -> Texture:
    """Lay a pattern onto the background of a camera, upright and in the middle of its image."""
    height, width = camera.image_size
    middle = torch.tensor([[(width - 1) / 2, (height - 1) / 2]], dtype=torch.float64)
    ray = camera.rays(middle)
    centre = ray.end_points[0]
    normal = camera.plane.normal.to(torch.float64)
    normal = normal if float(normal @ ray.direction[0]) > 0 else -normal
    right = torch.linalg.cross(camera.rotation[1], normal)
    right = right / right.norm()
    down = torch.linalg.cross(normal, right)
    rows, columns = values.shape
    corner = centre - right * (columns * texel / 2) - down * (rows * texel / 2)
    return Texture(values, texel, corner, right, down)


def pattern_size(camera: Camera) -> tuple[float, float]:
    """Return width and height (mm) of a pattern that fills the image of a camera, with a margin of a tenth."""
    height, width = camera.image_size
    edge = torch.tensor([-0.5, 0.5], dtype=torch.float64)
    corners = torch.cartesian_prod(edge * width + (width - 1) / 2, edge * height + (height - 1) / 2)
    rays = camera.rays(corners)
    hits = rays.end_points
    texture = background_texture(camera, torch.zeros(2, 2, dtype=torch.float64), 1.0)
    centre = texture.corner + texture.right + texture.down
    reach = ((hits - centre) @ torch.stack([texture.right, texture.down], dim=1)).abs().amax(dim=0)
    return 2.2 * float(reach[0]), 2.2 * float(reach[1])


@torch.no_grad()
def render(
    camera: Camera,
    texture: Texture,
    field: Field | None = None,
    box: Box | None = None,
    n_ambient: float = 1.0,
    samples: int = 3,
    steps: int = STEPS,
) -> Float[Tensor, "row column"]:
    """Return the light that reaches each pixel, 0 (black) to 1 (white paper).

    Parameters
    ----------
    camera : its own background plane plays no part: the texture's does, to which a lens without focus is focused
    texture : what it looks at
    field, box : what lies between, of index excess, and where; None is the reference
    n_ambient : refractive index around the field
    samples : points along each edge of a pixel over which the texture is averaged. Rays are bent at pixel centres and
        their movement on the plane interpolated between them by cubic splines (tests/simulation/test_rendering.py: the
        difference to bending every one)
    steps : Runge-Kutta steps through the box
    """
    if samples < 1:
        raise InputError(f"expected at least one point along the edge of a pixel, got {samples}", field="samples")
    height, width = camera.image_size
    shift = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples - 0.5
    camera = replace(camera, background=texture.plane, lens=(camera.without_window.lens or Lens()))
    assert camera.lens is not None
    light, offsets = torch.zeros(height, width, dtype=torch.float64), camera.lens.offsets()
    for offset in offsets:
        movement = None
        if field is not None:
            assert box is not None
            centres = _rays(camera, camera.pixel_grid().reshape(-1, 2), offset)
            movement = _movement(field, centres, texture.plane, box, n_ambient, steps).reshape(height, width, 3)
        for dv in shift:
            for du in shift:
                pixels = camera.pixel_grid() + torch.stack([du, dv])
                rays = _rays(camera, pixels.reshape(-1, 2), offset)
                points = rays.end_points
                if movement is not None:
                    points = points + _between(movement, float(dv), float(du)).reshape(-1, 3)
                light += texture.at(points).reshape(height, width)
    return light / (len(offsets) * samples**2)


def _rays(camera: Camera, pixels: Float[Tensor, "n 2"], offset: Float[Tensor, 4]) -> Rays:
    """Rays from a point of the lens through where each pixel is in focus, on to the background."""
    return camera.rays(pixels).through(offset.expand(len(pixels), 1, 4))


def _movement(field: Field, rays: Rays, plane: Plane, box: Box, n_ambient: float, steps: int) -> Float[Tensor, "n 3"]:
    """How far (mm) on the plane refraction moves the point that each ray meets."""
    rays = rays.clip(box)
    moved = torch.zeros_like(rays.origin)
    for part in torch.split(rays.crosses.nonzero()[:, 0], 1 << 14):
        chosen = rays[part]
        position, heading = trace(field, chosen.to(dtype=torch.float32), steps, n_ambient)
        # in single precision the straight ray is off by 1e-4 mm: move only by what the field bends
        start = chosen.to(dtype=torch.float32)
        length = (start.far - start.near).double()[:, None]
        exit_ = (start.origin + start.near[:, None] * start.direction).double() + length * start.direction.double()
        straight = torch.nn.functional.normalize(start.direction.double(), dim=-1)
        moved[part] = _hit(position, heading, plane) - _hit(exit_, straight, plane)
    return moved


def _hit(position: Tensor, heading: Tensor, plane: Plane) -> Tensor:
    reach = (plane.offset - position @ plane.normal) / (heading @ plane.normal)
    return position + reach[:, None] * heading


def _between(movement: Float[Tensor, "row column 3"], dv: float, du: float) -> Float[Tensor, "row column 3"]:
    """The movement at pixel centres, moved by a part of a pixel."""
    if dv == 0 and du == 0:
        return movement
    from scipy.ndimage import shift

    moved = shift(movement.numpy(), (-dv, -du, 0), order=3, mode="nearest")
    return torch.from_numpy(moved)
