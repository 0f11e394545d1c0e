"""Rendered images: a textured plane through a field by curved rays, with lens, pixels and noise.

A pixel averages over its area and over the lens. Each ray is bent by the field and meets the plane at X; the image
is the mean of the texture at X. Without a field the same rays are straight: the reference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.arrays import Points
from nerif.common.conventions import InputError
from nerif.fields.field import Field
from nerif.forward.ray_tracing import trace
from nerif.geometry import Box, Camera, Lens, Plane, Rays
from nerif.simulation.simulate import STEPS

__all__ = ["Texture", "background_texture", "pattern_size", "render"]


@dataclass(frozen=True)
class Texture:
    """A printed plane in space."""

    values: Float[Tensor, "row column"]  #: reflectance, 0 to 1
    texel: float  #: edge of a texel, mm
    corner: Float[Tensor, 3]  #: outer corner of the first texel, mm, world frame
    right: Float[Tensor, 3]  #: unit vector along columns
    down: Float[Tensor, 3]  #: unit vector along rows
    surround: float = 0.5  #: reflectance beyond the edges

    @classmethod
    def around(
        cls, centre: Float[Tensor, 3], right: Float[Tensor, 3], down: Float[Tensor, 3],
        values: Float[Tensor, "row column"], texel: float,
    ) -> Texture:  # fmt: skip
        """Return a texture by the position of its centre, mm."""
        rows, columns = values.shape
        return cls(values, texel, centre - right * (columns * texel / 2) - down * (rows * texel / 2), right, down)

    @property
    def plane(self) -> Plane:
        """Plane of the texture."""
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


def background_texture(camera: Camera, values: Float[Tensor, "row column"], texel: float) -> Texture:
    """Lay a pattern onto the background of a camera, upright and in the middle of its image."""
    height, width = camera.image_size
    ray = camera.rays(torch.tensor([[(width - 1) / 2, (height - 1) / 2]], dtype=torch.float64))
    normal = camera.plane.normal.to(torch.float64)
    normal = normal if float(normal @ ray.direction[0]) > 0 else -normal
    right = torch.linalg.cross(camera.rotation[1], normal)
    right = right / right.norm()
    return Texture.around(ray.end_points[0], right, torch.linalg.cross(normal, right), values, texel)


def pattern_size(camera: Camera) -> tuple[float, float]:
    """Return width and height (mm) of a pattern that fills the image of a camera, with a margin of a tenth."""
    height, width = camera.image_size
    edge = torch.tensor([-0.5, 0.5], dtype=torch.float64)
    corners = torch.cartesian_prod(edge * width + (width - 1) / 2, edge * height + (height - 1) / 2)
    texture = background_texture(camera, torch.zeros(2, 2, dtype=torch.float64), 1.0)
    centre = texture.corner + texture.right + texture.down
    axes = torch.stack([texture.right, texture.down], dim=1)
    reach = ((camera.rays(corners).end_points - centre) @ axes).abs().amax(dim=0)
    return 2.2 * float(reach[0]), 2.2 * float(reach[1])


@torch.no_grad()
def render(
    camera: Camera, texture: Texture, field: Field | None = None, box: Box | None = None, n_ambient: float = 1.0,
    samples: int = 3, steps: int = STEPS,
) -> Float[Tensor, "row column"]:  # fmt: skip
    """Return the light that reaches each pixel, 0 (black) to 1 (white paper).

    Parameters
    ----------
    camera : its background plane is replaced by the texture's, on which a lens without focus is focused
    field, box : index excess between camera and texture, and its box; None for the reference
    n_ambient : refractive index around the field
    samples : points along each edge of a pixel over which the texture is averaged. Rays are bent at pixel centres and
        their shift on the plane is interpolated by cubic splines (error: tests/simulation/test_rendering.py)
    steps : Runge-Kutta steps through the box
    """
    if samples < 1:
        raise InputError(f"expected at least one point along the edge of a pixel, got {samples}", field="samples")
    height, width = camera.image_size
    points = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples - 0.5
    camera = replace(camera, background=texture.plane, lens=(camera.without_window.lens or Lens()))
    assert camera.lens is not None
    light, offsets = torch.zeros(height, width, dtype=torch.float64), camera.lens.offsets()
    for offset in offsets:
        shift = None
        if field is not None:
            assert box is not None
            centres = _rays(camera, camera.pixel_grid().reshape(-1, 2), offset)
            shift = _shift(field, centres, texture.plane, box, n_ambient, steps).reshape(height, width, 3)
        for dv in points:
            for du in points:
                pixels = camera.pixel_grid() + torch.stack([du, dv])
                hits = _rays(camera, pixels.reshape(-1, 2), offset).end_points
                if shift is not None:
                    hits = hits + _between(shift, float(dv), float(du)).reshape(-1, 3)
                light += texture.at(hits).reshape(height, width)
    return light / (len(offsets) * samples**2)


def _rays(camera: Camera, pixels: Float[Tensor, "n 2"], offset: Float[Tensor, 4]) -> Rays:
    """Rays from a point of the lens through the focus of each pixel to the background."""
    rays = camera.rays(pixels, sensitivity=False)
    return rays.through(offset.expand(len(pixels), 1, 4)) if bool(offset.any()) else rays


def _shift(field: Field, rays: Rays, plane: Plane, box: Box, n_ambient: float, steps: int) -> Float[Tensor, "n 3"]:
    """Shift (mm) on the plane, by refraction, of the end point of each ray."""
    rays = rays.clip(box)
    shift = torch.zeros_like(rays.origin)
    for part in torch.split(rays.crosses.nonzero()[:, 0], 1 << 14):
        start = rays[part].to(dtype=torch.float32)
        position, heading = trace(field, start, steps, n_ambient)
        # in single precision the straight ray has an error of 1e-4 mm: take the difference of the two
        length = (start.far - start.near).double()[:, None]
        exit_ = (start.origin + start.near[:, None] * start.direction).double() + length * start.direction.double()
        straight = torch.nn.functional.normalize(start.direction.double(), dim=-1)
        shift[part] = _hit(position, heading, plane) - _hit(exit_, straight, plane)
    return shift


def _hit(position: Tensor, heading: Tensor, plane: Plane) -> Tensor:
    reach = (plane.offset - position @ plane.normal) / (heading @ plane.normal)
    return position + reach[:, None] * heading


def _between(values: Float[Tensor, "row column 3"], dv: float, du: float) -> Float[Tensor, "row column 3"]:
    """Values at pixel centres, interpolated at an offset within the pixel."""
    if dv == 0 and du == 0:
        return values
    from scipy.ndimage import shift

    return torch.from_numpy(shift(values.numpy(), (-dv, -du, 0), order=3, mode="nearest"))
