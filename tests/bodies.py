"""Meshes of simple bodies for tests."""

from __future__ import annotations

import math

import torch

from nerif.geometry.body import Body

CUBE_FACES = [
    [0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4],
    [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7],
]  # fmt: skip


def cuboid(lower=(-5.0, -5.0, -5.0), upper=(5.0, 5.0, 5.0), name: str = "cuboid") -> Body:
    """A cuboid of twelve triangles."""
    (x0, y0, z0), (x1, y1, z1) = lower, upper
    square = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    vertices = torch.tensor([(x, y, z) for z in (z0, z1) for x, y in square], dtype=torch.float64)
    return Body(vertices, torch.tensor(CUBE_FACES), name)


def ball(radius: float = 6.0, centre=(0.0, 0.0, 0.0), rings: int = 40, name: str = "ball") -> Body:
    """A ball of triangles between meridians and parallels."""
    angles = torch.arange(1, rings, dtype=torch.float64) * math.pi / rings
    turns = torch.arange(2 * rings, dtype=torch.float64) * math.pi / rings
    theta, phi = (x.flatten() for x in torch.meshgrid(angles, turns, indexing="ij"))
    middle = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], dim=1)
    poles = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    n, count = 2 * rings, len(middle)
    faces = []
    for j in range(n):
        k = (j + 1) % n
        faces += [[count, j, k], [count + 1, count - n + k, count - n + j]]
        for i in range(rings - 2):
            a, b = i * n + j, i * n + k
            faces += [[a, a + n, b], [b, a + n, b + n]]
    vertices = torch.cat([middle, poles]) * radius + torch.tensor(centre, dtype=torch.float64)
    return Body(vertices, torch.tensor(faces), name)
