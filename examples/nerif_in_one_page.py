"""NeRIF on one page, in plain PyTorch: rays, samples, gradient, weights, loss, step.

    nerif simulate --phantom flame --image-size 48 48 -o m.nc
    python examples/nerif_in_one_page.py m.nc field.nc

A pixel p, seen along the ray x(s) = o + s e that ends on the background at s_b, is displaced by

    d(p) = integral (s_b - s) S grad n(x(s)) / n_ambient ds,     S = -d project / d X at x(s_b)     [px]

and a network n(x) is trained until these displacements are the measured ones (tests/test_one_page.py: as in nerif).
"""

import itertools
import math
import sys
from typing import NamedTuple

import torch
import xarray
from torch import Tensor, nn

VARIABLES = ("intrinsics", "rotation", "translation", "background_normal", "background_offset", "displacement")


class Rays(NamedTuple):
    """Rays of all pixels (mm, world frame) with their measured displacements."""

    origin: Tensor  # (n, 3) camera centre o
    direction: Tensor  # (n, 3) unit vector e
    near: Tensor  # (n,) path length to the box
    far: Tensor  # (n,) and out of it
    background: Tensor  # (n,) path length s_b to the background
    sensitivity: Tensor  # (n, 2, 3) S, px/mm
    displacement: Tensor  # (n, 2) measured d, px


def read_rays(file: xarray.Dataset) -> Rays:
    """Return the rays of all valid pixels that cross the box, for perspective cameras without distortion."""
    (lower, upper), views = torch.tensor(file["box"].values), []
    for view in range(file.sizes["view"]):
        of_view = {name: torch.tensor(file[name].values[view]).double() for name in VARIABLES}
        k, r, t, normal, offset, d = of_view.values()
        row, column = torch.meshgrid(*(torch.arange(size).double() for size in d.shape[:2]), indexing="ij")
        pixel = torch.stack([column, row, torch.ones_like(row)], dim=-1).reshape(-1, 3)
        direction = nn.functional.normalize(pixel @ torch.linalg.inv(k).T @ r, dim=1)
        origin = (-t @ r).expand_as(direction)
        to_background = (offset - origin @ normal) / (direction @ normal)
        x, y, z = ((origin + to_background[:, None] * direction) @ r.T + t).unbind(1)  # camera frame
        du = torch.stack([k[0, 0] / z, k[0, 1] / z, -(k[0, 0] * x + k[0, 1] * y) / z**2], dim=1)
        dv = torch.stack([0 * z, k[1, 1] / z, -k[1, 1] * y / z**2], dim=1)
        a, b = (lower - origin) / direction, (upper - origin) / direction
        near, far = torch.minimum(a, b).amax(1), torch.maximum(a, b).amin(1)
        rays = Rays(origin, direction, near, far, to_background, -torch.stack([du, dv], dim=1) @ r, d.reshape(-1, 2))
        usable = (far > near) & rays.displacement.isfinite().all(1)
        views.append([column[usable].float() for column in rays])
    return Rays(*(torch.cat(columns) for columns in zip(*views, strict=True)))


class Network(nn.Module):
    """Index excess in units of `scale` over coordinates in [-1, 1]: sinusoidal encoding, then four layers of 96."""

    def __init__(self, octaves: int = 5, width: int = 96, depth: int = 4) -> None:
        super().__init__()
        lines = [v for v in itertools.product((1, 0, -1), repeat=3) if v > tuple(-x for x in v)]
        lines.sort(key=lambda v: sum(map(abs, v)))  # the three axes and the ten diagonals of a cube
        unit = nn.functional.normalize(torch.tensor(lines).double(), dim=1)
        self.waves = torch.cat([math.pi * 2.0**k * e for e in (unit[:3], unit[3:]) for k in range(octaves)]).float()
        sizes = itertools.pairwise([3 + 2 * len(self.waves)] + depth * [width])
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in sizes)
        self.outputs = nn.ModuleList([nn.Linear(width, 1)])

    def forward(self, p: Tensor) -> Tensor:
        phase = p @ self.waves.T
        h = torch.cat([p, phase.sin(), phase.cos()], dim=1)
        for layer in self.layers:
            h = nn.functional.silu(layer(h))
        return self.outputs[0](h)[:, 0]


class Field(NamedTuple):
    """The network in physical units (mm): n = n_ambient + scale network((x - centre) / half_edge)."""

    network: Network
    centre: Tensor
    half_edge: float
    scale: float
    n_ambient: float

    def value(self, x: Tensor) -> Tensor:
        """Return the network's output at points (n, 3) in mm."""
        return self.network((x - self.centre) / self.half_edge)

    def gradient(self, x: Tensor) -> Tensor:
        """Return grad n at points (n, 3) that require a gradient, 1/mm."""
        return self.scale * torch.autograd.grad(self.value(x).sum(), x, create_graph=True)[0]


def sample(rays: Rays, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return path lengths (n, m), one at random in each of m equal intervals of a ray, and the intervals, mm."""
    share = (torch.arange(count) + torch.rand(len(rays.near), count, generator=generator)) / count
    length = (rays.far - rays.near)[:, None]
    return rays.near[:, None] + share * length, (length / count).expand(-1, count)


def predict(field: Field, rays: Rays, s: Tensor, interval: Tensor) -> Tensor:
    """Return the displacements (n, 2) of rays, px: the sum over samples of weight x S x gradient."""
    x = rays.origin[:, None] + s[..., None] * rays.direction[:, None]
    gradient = field.gradient(x.reshape(-1, 3).requires_grad_()).reshape(x.shape)
    weight = (rays.background[:, None] - s) * interval / field.n_ambient
    return torch.einsum("nm,nij,nmj->ni", weight, rays.sensitivity, gradient)


def loss(field: Field, rays: Rays, s: Tensor, interval: Tensor, ambient: Tensor, size: float) -> Tensor:
    """Return the mean squared residual in units of `size` (px), and the gauge: n = n_ambient at points on the sides."""
    residual = (predict(field, rays, s, interval) - rays.displacement) / size
    return residual.square().mean() + field.value(ambient).square().mean()


def main() -> None:
    with xarray.open_dataset(sys.argv[1]) as file:
        rays, box, n_ambient = read_rays(file), torch.tensor(file["box"].values).float(), file.attrs["n_ambient"]
    generator, edges = torch.manual_seed(0), box[1] - box[0]
    size = rays.displacement.square().mean().sqrt().item()
    lever = (rays.background - (rays.near + rays.far) / 2) * rays.sensitivity.square().sum(2).mean(1).sqrt()
    scale = size / lever.square().mean().sqrt().item()  # so that the network's output is of order 1
    field = Field(Network(), box.mean(0), edges.max().item() / 2, scale, n_ambient)
    optimiser = torch.optim.Adam(field.network.parameters(), lr=1e-2, betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 1000)
    for step in range(1, 1001):
        index = torch.randint(len(rays.near), (512,), generator=generator)
        batch = Rays(*(column[index] for column in rays))  # a random batch
        axis, side = torch.randint(2, (2, 256), generator=generator)
        ambient = box[0] + torch.rand(256, 3, generator=generator) * edges
        ambient[torch.arange(256), axis] = box[side, axis]  # on x-, x+, y- or y+
        value = loss(field, batch, *sample(batch, 24, generator), ambient, size)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        schedule.step()
        print(f"\rstep {step}: loss {value.item():.3g}", end="", flush=True)
    x, y, z = (torch.linspace(low, high, 64) for low, high in box.T.tolist())  # mm
    points = torch.stack(torch.meshgrid(z, y, x, indexing="ij")[::-1], dim=-1)
    excess = field.scale * field.value(points.reshape(-1, 3)).reshape(64, 64, 64).detach().numpy()
    volume = xarray.DataArray(excess, {"z": z.numpy(), "y": y.numpy(), "x": x.numpy()}, name="index_excess")
    volume.to_netcdf(sys.argv[2], engine="h5netcdf")


if __name__ == "__main__":
    main()
