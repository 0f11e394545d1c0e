"""
A body in the flow
==================

A wind-tunnel model hides a part of the background, and the flow on its two sides has nothing to do with each other.
Here it is a plate, thinner than a pixel, with compressed air below and expanded air above; the measurement is
simulated.
"""

# %%
# The flow
# --------
# Any function of the position with its gradient is a field. This one jumps across the plate and is continuous around
# its edges.
import torch

import nerif
from nerif.fields.field import Field
from nerif.geometry import Box, Ring


class OverAndUnder(Field):
    """Density above ambient below the plate, below ambient above it."""

    def value_and_gradient(self, points):
        with torch.enable_grad():
            p = points.detach().reshape(-1, 3).clone().requires_grad_()
            x, y, z = p.unbind(-1)
            span = (1 - (x / 10) ** 2).clamp_min(0) * (1 - (y / 8) ** 2).clamp_min(0)
            value = -2e-5 * torch.sign(z) * span**2 * torch.exp(-((z / 4) ** 2))
            (gradient,) = torch.autograd.grad(value.sum(), p)
        shape = points.shape
        return value.detach().reshape(shape[:-1]), gradient.reshape(shape)


box = Box.cube(40.0)
ring = Ring(views=7, arc=(0.0, 155.0), image_size=(64, 64), pixel_pitch=4.0 / 64)
cameras = ring.cameras()
measurement = nerif.simulate(
    OverAndUnder(), cameras, box, n_ambient=1.00027, noise=0.05
)

# %%
# The body
# --------
# A closed surface of triangles. :func:`nerif.data.body_file.read_body` reads one from STL, OBJ or PLY; a plate is
# quickly made. Pixels that see it have no data any more.
from nerif.geometry.body import Body
from nerif.imaging.bodies import with_bodies

corners = [(x, y, z) for z in (-0.25, 0.25) for y in (-8.0, 8.0) for x in (-10.0, 10.0)]
sides = [
    (0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4),
    (2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5),
]  # fmt: skip
plate = Body(torch.tensor(corners), torch.tensor(sides), "plate")
measurement = with_bodies(measurement, [plate])
hidden = measurement.hidden.float().mean()
print(
    f"{plate.name}: {plate.volume:.0f} mm3; it hides {float(hidden):.1%} of the pixels"
)

# %%
# The field
# ---------
# The network has the direction from the nearest surface among its inputs, so its field may jump there, and only there.
result = nerif.preset("fast", max_steps=300)(measurement)
result

# %%
# Its slices are empty within the body. The jump is as sharp as the plate is thin.
import matplotlib.pyplot as plt

z = torch.linspace(-12, 12, 481)
line = torch.stack([torch.full_like(z, 2.0), torch.full_like(z, 1.0), z], dim=-1)
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.plot(z, 1e6 * OverAndUnder()(line), "k", label="truth")
axes.plot(z, 1e6 * result.field(line), label="reconstruction")
axes.axvspan(-0.25, 0.25, color="0.8", label="plate")
axes.set(xlabel="z in mm", ylabel="index excess, 1e-6")
_ = axes.legend()

# %%
# The surface
# -----------
# The density on the plate, as ``nerif reconstruct`` writes it to ``surface.vtp`` for ParaView and draws it in the
# report.
from nerif.analysis.wall_values import surface_map
from nerif.physics.gas import GasSettings
from nerif.report.surface_figure import draw_surface

surface = surface_map(
    result.field, result.bodies, box, result.n_ambient, edge=0.8, medium=GasSettings()
)
figure = plt.figure(figsize=(7, 3.5), layout="constrained")
draw_surface(figure, surface, "density")

# %%
# Without the body
# ----------------
# The same network without it smooths the jump, although the same pixels are hidden.
from dataclasses import replace

blind = nerif.preset("fast", max_steps=300)(replace(measurement, bodies=()))
points = torch.rand(4000, 3) * 30 - 15
points = points[~plate.contains(points)]
truth = OverAndUnder()(points)
for name, field in (("with the plate", result.field), ("without", blind.field)):
    error = float((field(points) - truth).norm() / truth.norm())
    print(f"{name:<15} error {error:.1%}")
