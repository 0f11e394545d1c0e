"""From arrays of your own to a measurement file: displacements, calibration, background, box.

    python examples/own_data.py mine.nc
    nerif info mine.nc                      # does the file hold what you mean?
    nerif reconstruct mine.nc -o mine

Here the arrays are made up: four cameras that see two hot plumes of different size. Put yours in their place;
docs/conventions.md defines frames and signs.
"""

from __future__ import annotations

import sys

import numpy as np
import torch

from nerif.data.measurement import Measurement
from nerif.geometry import Box, Camera, Plane

# What a calibration gives, one entry a camera. World frame and lengths in mm, image quantities in px.
K = np.array([[1500.0, 0, 59.5], [0, 1500.0, 44.5], [0, 0, 1]])
HEIGHT, WIDTH, TO_CAMERA, TO_BACKGROUND = 90, 120, 700.0, 500.0  # distances from the origin, which is in the flow
cameras = []
for angle in (0, 45, 90, 135):
    outward = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])  # from the flow to the camera
    R = np.stack([np.cross(-outward, [0, 0, 1]), [0, 0, -1], -outward])  # rows: right, down, forward
    t = -R @ (TO_CAMERA * outward)  # x_camera = R x_world + t
    cameras.append(
        Camera(
            intrinsics=torch.tensor(K),
            rotation=torch.tensor(R),
            translation=torch.tensor(t),
            image_size=(HEIGHT, WIDTH),
            background=Plane(torch.tensor(outward), -TO_BACKGROUND),  # normal . x = offset
            distortion=torch.zeros(5, dtype=torch.float64),  # k1, k2, p1, p2, k3
            name=f"{angle}deg",
        )
    )

# The made-up flow: index excess, centre (x, y) and radius of each plume.
PLUMES = ((-1.2e-4, (5.0, -3.0), 4.0), (-0.7e-4, (-6.0, 5.0), 3.0))
BEND = 9.0  # mm: the plumes fade with height


def gradient(points: np.ndarray) -> np.ndarray:
    """Gradient of the index at points (..., 3), 1/mm."""
    total = np.zeros_like(points)
    for excess, centre, radius in PLUMES:
        offset = points - np.array([*centre, 0.0])
        widths = np.array([radius, radius, BEND])
        value = excess * np.exp(-0.5 * ((offset / widths) ** 2).sum(axis=-1))
        total -= value[..., None] * offset / widths**2
    return total


# What the optical flow gives: (view, row, column, component), NaN where there is nothing.
# d is where a dot appears with flow minus where it appears without (px, u right, v down), on the flow image: minus the
# optical flow from the flow image to the reference. Here: the integral of the gradient across the line of sight, times
# the lever arm.
noise, sigma = np.random.default_rng(0), 0.02  # px
v, u = np.mgrid[:HEIGHT, :WIDTH]
along = np.linspace(TO_CAMERA - 25, TO_CAMERA + 25, 101)  # mm from the camera
displacement = np.empty((len(cameras), HEIGHT, WIDTH, 2), dtype=np.float32)
for view, camera in zip(displacement, cameras, strict=True):
    R, centre = camera.rotation.numpy(), camera.centre.numpy()
    sight = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1) @ R
    angles = sum(gradient(centre + distance * sight) for distance in along) * (along[1] - along[0])
    view[:] = -K[0, 0] * TO_BACKGROUND / (TO_CAMERA + TO_BACKGROUND) * (angles @ R.T)[..., :2]
    view += noise.normal(scale=sigma, size=view.shape)
displacement[:, :5] = np.nan  # rows without data

measurement = Measurement(
    cameras=tuple(cameras),
    displacement=torch.tensor(displacement),
    box=Box((-20.0, -20.0, -15.0), (20.0, 20.0, 15.0)),  # the volume of interest
    n_ambient=1.00027,
    sigma=torch.full(displacement.shape, sigma),  # px; leave it out if you do not know it
    wavelength_nm=532.0,
    ambient_faces=("x-", "x+", "y-", "y+"),  # where the index is that of the ambient
)
measurement.write(sys.argv[1])
print(measurement)
