"""
Velocity from a film of densities
=================================

A density that moves shows how the fluid moves. Here light fluid is carried by a vortex ring whose velocity is known
exactly, by another formula than the solver's.
"""

# %%
# The film
# --------
# Fluid that is at a point now was elsewhere before. Its path back through the ring gives the density at every instant.
import torch

from nerif.data.volume import Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.geometry import Box, Grid
from nerif.simulation.particles.ring import VortexRing

box = Box.cube(60.0)
grid = Grid(box, (28, 28, 28))
ring = VortexRing(radius=12.0, core=6.0, circulation=9000.0)
times = [0.005 * k for k in range(7)]
points = grid.points(torch.float64).reshape(-1, 3)


def theta(x):
    """Light fluid in the shape of an egg, with stripes."""
    shape = torch.exp(
        -(((x[:, 0] / 16) ** 2 + (x[:, 1] / 16) ** 2 + (x[:, 2] / 11) ** 2) ** 2)
    )
    return 0.1 * shape * (1 + 0.4 * torch.sin(x[:, 0] / 4) * torch.cos(x[:, 2] / 4))


frames, back = [], points.clone()
for _ in times:
    frames.append(theta(back).reshape(grid.shape).float())
    for _ in range(4):  # steps of 1.25 ms
        halfway = back - 0.000625 * ring.velocity(back)
        back = back - 0.00125 * ring.velocity(halfway)

n_ambient = 1.00027
film = VolumeSequence.create("film.zarr", times, grid, ("index_excess",), n_ambient)
for k, frame in enumerate(frames):
    film.write(k, [Volume.of((1 - n_ambient) * frame, grid, "index_excess", n_ambient)])

# %%
# The velocity
# ------------
# No gravity drives this flow, so its momentum is left open. In Python and at the command line:
# ``nerif velocity film.zarr -o velocity.zarr --physics transport``.
from nerif.flow.assimilation import VelocityFit
from nerif.workflow.film_velocity import velocity_of_film

fit = VelocityFit(
    physics="transport", diffusivity=0.01, resolution=24, max_iterations=40, samples=3
)
velocity = velocity_of_film("film.zarr", "velocity.zarr", fit, force=True, say=print)

# %%
# What it is worth
# ----------------
# It is given where the density is carried. The truth, which no measurement has, is compared there.
true = ring.velocity(points).T.reshape(3, *grid.shape).float() / 1e3
vectors = velocity.vectors(3)
where = vectors.isfinite().all(dim=0) & (frames[3] > 0.05 * frames[3].max())
error = (vectors - true)[:, where].norm() / true[:, where].norm()
stated = torch.stack([velocity.volume(3, f"{name}_std").values for name in "uvw"])
print(
    f"error {float(error):.0%}, stated {float(stated[:, where].norm() / true[:, where].norm()):.0%}"
)

# %%
# Arrows and streamlines
# ----------------------
# The report of the result and ``nerif movie velocity.zarr -o flow.mp4 --style streamlines`` have these for all instants.
import matplotlib.pyplot as plt

from nerif.report.velocity_figure import draw_arrows, draw_streamlines

draw_arrows(plt.figure(figsize=(9, 4)), velocity, 3)
draw_streamlines(plt.figure(figsize=(9, 4)), velocity, 3)
