"""A puffing axisymmetric plume by finite differences of vorticity and stream function, in a closed cylinder.

    Dw/Dt = u w / r + nu (lap w - w / r^2) - g dtheta/dr,      (lap - 1 / r^2) A = -w,      u = curl(A e_phi)

Upwind differences of third order, Runge-Kutta steps of third order; cell centres at (i + 1/2) h. Not nerif's solver.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import diags, identity, kron
from scipy.sparse.linalg import splu

RADIUS, HEIGHT = 40.0, 120.0  # mm
NU, KAPPA, GRAVITY = 30.0, 30.0, 9810.0


@dataclass(frozen=True)
class Plume:
    """theta (t, z, r), velocity (t, 2, z, r) along r and z in mm/s, at times (s) and cell centres (mm)."""

    times: np.ndarray
    r: np.ndarray
    z: np.ndarray
    theta: np.ndarray
    velocity: np.ndarray


def plume(times: np.ndarray, h: float = 1.0, strength: float = 1.6, period: float = 0.06) -> Plume:
    """Return a plume above a source at z = 15 mm.

    Parameters
    ----------
    h : distance of cell centres, mm
    strength : growth of theta at the source, 1/s
    period : of the source, s
    """
    r, z = np.arange(0.5 * h, RADIUS, h), np.arange(0.5 * h, HEIGHT, h)
    rr, zz = np.meshgrid(r, z)
    shape = np.exp(-((rr / 7.0) ** 2) - ((zz - 15.0) / 5.0) ** 2)
    poisson = splu(_operator(r, len(z), h).tocsc())

    def flow(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a = poisson.solve(-w.reshape(-1)).reshape(w.shape)
        up, out = _pad(a, -1, -1), np.concatenate([-rr[:, :1], rr, rr[:, -1:] + h], axis=1)
        return -(up[2:, 1:-1] - up[:-2, 1:-1]) / (2 * h), (up[1:-1] * out)[:, 2:] / (2 * h * rr) - (up[1:-1] * out)[
            :, :-2
        ] / (2 * h * rr)

    def rates(theta: np.ndarray, w: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray]:
        u, v = flow(w)
        heat = strength * (1 + 0.8 * np.sin(2 * np.pi * t / period)) * shape
        padded = _pad(theta, 1, 1)
        torque = -GRAVITY * (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2 * h)
        dtheta = -_advection(theta, u, v, h, 1) + KAPPA * _laplacian(theta, rr, h, 1) + heat
        dw = -_advection(w, u, v, h, -1) + u * w / rr + NU * (_laplacian(w, rr, h, -1) - w / rr**2) + torque
        return dtheta, dw

    theta, w, t, frames = np.zeros_like(rr), np.zeros_like(rr), 0.0, []
    step = min(0.15 * h**2 / NU, 0.001 * h)
    for end in times:
        while t < end - 1e-9:
            dt = min(step, end - t)
            a = rates(theta, w, t)
            b = [f + dt * k for f, k in zip((theta, w), a, strict=True)]
            k = rates(*b, t + dt)
            b = [0.75 * f + 0.25 * (g + dt * s) for f, g, s in zip((theta, w), b, k, strict=True)]
            k = rates(*b, t + 0.5 * dt)
            theta, w = (f / 3 + 2 / 3 * (g + dt * s) for f, g, s in zip((theta, w), b, k, strict=True))
            t += dt
        frames.append((theta, np.stack(flow(w))))
    return Plume(times, r, z, np.stack([f[0] for f in frames]), np.stack([f[1] for f in frames]))


def _pad(values: np.ndarray, axis: int, wall: int, width: int = 1) -> np.ndarray:
    """Values mirrored about the axis and the walls, with these signs."""
    left, right = axis * values[:, :width][:, ::-1], wall * values[:, -width:][:, ::-1]
    wide = np.concatenate([left, values, right], axis=1)
    return np.concatenate([wall * wide[:width][::-1], wide, wall * wide[-width:][::-1]])


def _advection(f: np.ndarray, u: np.ndarray, v: np.ndarray, h: float, parity: int) -> np.ndarray:
    """u . grad f, f even (1) or odd (-1) about axis and walls."""
    p, total = _pad(f, parity, parity, 2), np.zeros_like(f)
    nz, nr = f.shape
    for speed, axis in ((u, 1), (v, 0)):

        def at(shift: int, axis: int = axis) -> np.ndarray:
            dz, dr = (shift, 0) if axis == 0 else (0, shift)
            return p[2 + dz : 2 + dz + nz, 2 + dr : 2 + dr + nr]

        behind = (2 * at(1) + 3 * at(0) - 6 * at(-1) + at(-2)) / (6 * h)
        ahead = (-at(2) + 6 * at(1) - 3 * at(0) - 2 * at(-1)) / (6 * h)
        total += speed * np.where(speed > 0, behind, ahead)
    return total


def _laplacian(f: np.ndarray, r: np.ndarray, h: float, parity: int) -> np.ndarray:
    p = _pad(f, parity, parity)
    second = p[2:, 1:-1] + p[:-2, 1:-1] + p[1:-1, 2:] + p[1:-1, :-2] - 4 * f
    return second / h**2 + (p[1:-1, 2:] - p[1:-1, :-2]) / (2 * h * r)


def _operator(r: np.ndarray, nz: int, h: float):
    """lap - 1 / r^2 of odd functions, by the same differences."""
    n = len(r)
    lower, upper = 1 / h**2 - 1 / (2 * h * r), 1 / h**2 + 1 / (2 * h * r)
    middle = -2 / h**2 - 1 / r**2
    middle[0] -= lower[0]
    middle[-1] -= upper[-1]
    radial = diags([lower[1:], middle, upper[:-1]], [-1, 0, 1], shape=(n, n))
    along = diags([np.ones(nz - 1), -2 * np.ones(nz), np.ones(nz - 1)], [-1, 0, 1]).tolil()
    along[0, 0] = along[-1, -1] = -3
    return kron(identity(nz), radial) + kron(along.tocsr() / h**2, identity(n))
