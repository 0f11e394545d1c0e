"""
A technique of your own
=======================

Background-oriented schlieren, absorption, emission and interferometry are built in. Another technique is a class with
two methods: what does a pixel see of the field along its ray? Here it is knife-edge schlieren, the classical form, in
forty lines.
"""

# %%
# The forward model
# -----------------
# A knife edge in the focus of a second lens (focal length f) cuts off a part of the image of the source; a height a
# of it passes. A deflection towards the edge or away from it changes the intensity of a pixel,
#
# .. math:: \frac{\Delta I}{I_0} = \frac{f}{a} \int \frac{1}{n} \frac{\partial n}{\partial x'} \, \mathrm{d}s
#
# with x' across the edge, here horizontal in the image. The model returns quadrature weights for samples along each
# ray: of the field (``value``) or, as here, of its gradient (``slope``), one row for each channel of the data.
from dataclasses import dataclass

import torch

import nerif
from nerif.forward.forward_model import ForwardModel, Weights
from nerif.forward.registry import TECHNIQUES


@dataclass(frozen=True)
class KnifeEdge(ForwardModel):
    """Relative change of intensity behind a vertical knife edge."""

    name = "knife_edge"
    tomography = "knife-edge schlieren tomography"
    measured, sigma = "contrast", "contrast_sigma"
    channels = ("",)
    unit = "1"
    limits = (1e-12, 1e12)
    quantity = "index_excess"
    gauge = True

    n_ambient: float = 1.0
    focal_over_height: float = 1000 / 0.5

    @classmethod
    def of(cls, light, model):
        return cls(light.n_ambient)

    def weights(self, rays, s, step):
        up = torch.tensor([0.0, 0.0, 1.0]).to(rays.direction)
        across = torch.linalg.cross(rays.direction, up.expand_as(rays.direction))
        across = torch.nn.functional.normalize(across, dim=1)
        return Weights(
            step * self.focal_over_height / self.n_ambient, slope=across[:, None]
        )


TECHNIQUES[KnifeEdge.name] = KnifeEdge

# %%
# A measurement
# -------------
# Everything else follows from the class: simulation, files, checks, every reconstruction method, report. Eight views
# of random Gaussian balls of hot gas, with 5 % noise.
from nerif import Simulation

rig = nerif.Ring(views=8, arc=(0, 157.5), image_size=(48, 48), pixel_pitch=0.085)
measurement, truth = Simulation("gaussians", (KnifeEdge.name,), noise=0.05)(
    rig.cameras()
)
measurement

# %%
# By a network
# ------------
result = nerif.preset("fast", max_steps=300)(measurement)
result

# %%
# By voxels
# ---------
# The classical methods take the same weights.
voxels = nerif.Tikhonov(voxels=40)(measurement)
for name, reconstruction in (("network", result), ("Tikhonov", voxels)):
    scores = nerif.evaluate_volume(reconstruction.field, truth, measurement.n_ambient)
    print(
        f"{name:>9}: error of the variation {scores['l2_variation']:.1%}, CC {scores['cc']:.4f}"
    )

# %%
# In a file
# ---------
# The measurement is written and read like any other where the class is known: import its module before
# ``nerif.read``.
import tempfile
from pathlib import Path

path = Path(tempfile.mkdtemp()) / "knife_edge.nc"
measurement.write(path)
print(nerif.read(path))
