"""Particles in a vortex ring: four images at two instants, the volumes by MART, the velocity by correlation in 3-D.

    python examples/particles.py out/particles

Images and flow are simulated, so the truth is available for comparison. With images of your own, start from a
Measurement of emission for each instant (docs/formats.md).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from nerif.geometry import Grid
from nerif.reconstruction.voxels.multiplicative import MART
from nerif.simulation.particles.cloud import Particles, quality_factor
from nerif.simulation.particles.particle_images import images
from nerif.simulation.particles.particle_rig import four_cameras
from nerif.simulation.particles.particle_velocity import velocity_between
from nerif.simulation.particles.ring import VortexRing

parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
parser.add_argument("out", type=Path, nargs="?", default=Path("out/particles"), help="directory for the results")
parser.add_argument("--pixels", type=int, default=200, help="of an edge of each image")
parser.add_argument("--depth", type=int, default=40, help="of the volume, in pixels")
parser.add_argument("--per-pixel", type=float, default=0.05, help="particles a pixel")
parser.add_argument("--displacement", type=float, default=4.0, help="of the fastest particles, voxels")
parser.add_argument("--window", type=int, default=24, help="edge of the windows of the correlation, voxels")
arguments = parser.parse_args()
arguments.out.mkdir(parents=True, exist_ok=True)

# What the cameras see, at two instants.
cameras, box = four_cameras(arguments.pixels, arguments.depth)
seconds, voxel = 1e-3, 0.1
ring = VortexRing.within(box, arguments.displacement * voxel / seconds)
before = Particles.draw(box, round(arguments.per_pixel * arguments.pixels**2), seed=0)
after = ring.advect(before, seconds)
measurements = [images(particles, cameras, seed=i) for i, particles in enumerate((before, after))]
for name, measurement in zip(("before", "after"), measurements, strict=True):
    measurement.write(arguments.out / f"{name}.nc")

# Voxels of about a pixel; of the truth nothing is used.
voxels = round(max(box.edges) / voxel)
grid = Grid.of_resolution(box, voxels)
method = MART(voxels=voxels, basis="linear")
volumes = [method(measurement).volume(grid) for measurement in measurements]
velocity = velocity_between(*volumes, seconds, arguments.window)

# How good it is.
quality = quality_factor(volumes[0].values, before.volume(grid).values)
truth = ring.velocity(velocity.points.reshape(-1, 3)).reshape(velocity.points.shape)
error = velocity.rms_error(truth) / voxel
print(f"Q {quality:.3f}, rms error {error:.3f} voxel a component, valid at {velocity.valid.double().mean():.0%}")

figure, (left, middle, right) = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained")
left.imshow(measurements[0].maps["radiance"][0].numpy(), cmap="gray")
left.set_title("one of four images")
extent = (box.lower[1], box.upper[1], box.lower[2], box.upper[2])
middle.imshow(volumes[0].values[:, :, grid.shape[2] // 2].numpy(), cmap="gray", origin="lower", extent=extent)
middle.set_title("middle of the volume")
plane = velocity.points.shape[2] // 2
_, y, z = velocity.points[:, :, plane].numpy().transpose(2, 0, 1)
for values, colour, name in ((truth, "0.7", "truth"), (velocity.values, "tab:blue", "reconstructed")):
    _, v, w = values[:, :, plane].numpy().transpose(2, 0, 1)
    right.quiver(y, z, v, w, color=colour, angles="xy", scale_units="xy", scale=float(truth.norm(dim=-1).max()),
                 label=name)  # fmt: skip
right.set_title("velocity in that plane")
figure.legend(loc="outside lower right", ncols=2)
for axes in (middle, right):
    axes.set(xlabel="y [mm]", ylabel="z [mm]", aspect="equal")
figure.savefig(arguments.out / "particles.png", dpi=150)
np.savez(arguments.out / "velocity.npz", points=velocity.points, velocity=velocity.values)
