"""From arrays of your own to a measurement file: displacements, calibration, background, box.

    python examples/own_data.py mine.nc

Here the arrays are made up (two cameras that see a hot column). Put yours in their place; docs/conventions.md defines
frames and signs, and `nerif info mine.nc` shows whether the file holds what you mean.
"""

from __future__ import annotations

import sys

import numpy as np
import torch

from nerif.data.measurement import Measurement
from nerif.geometry import Box, Camera, Plane

# What a calibration gives, one entry a camera. World frame and lengths in mm, image quantities in px.
K = np.array([[2500.0, 0, 99.5], [0, 2500.0, 74.5], [0, 0, 1]])
cameras = []
for name, angle in (("left", 0.0), ("right", np.pi / 2)):
    outward = np.array([np.cos(angle), np.sin(angle), 0.0])  # from the flow to the camera
    R = np.stack([np.cross(-outward, [0, 0, 1]), [0, 0, -1], -outward])  # rows: right, down, forward
    t = -R @ (700.0 * outward)  # x_camera = R x_world + t
    normal, offset = outward, -500.0  # the background: normal . x = offset
    cameras.append(
        Camera(
            intrinsics=torch.tensor(K),
            rotation=torch.tensor(R),
            translation=torch.tensor(t),
            image_size=(150, 200),  # height, width
            background=Plane(torch.tensor(normal), offset),
            distortion=torch.zeros(5, dtype=torch.float64),  # k1, k2, p1, p2, k3
            name=name,
        )
    )

# What the optical flow gives: (view, row, column, component), NaN where there is nothing.
# d(p) = p - p0(p): the flow image shows at p what the reference shows at p0, so d is minus the optical flow from the
# flow image to the reference.
column = np.arange(200) - 99.5
u = -0.4 * column / 30 * np.exp(-0.5 * (column / 30) ** 2)
displacement = np.zeros((2, 150, 200, 2), dtype=np.float32)
displacement[..., 0] = u
displacement[:, :5] = np.nan

measurement = Measurement(
    cameras=tuple(cameras),
    displacement=torch.tensor(displacement),
    box=Box((-20.0, -20.0, -15.0), (20.0, 20.0, 15.0)),  # the volume of interest
    n_ambient=1.00027,
    sigma=torch.full(displacement.shape, 0.02),  # px; leave it out if you do not know it
    wavelength_nm=532.0,
    ambient_faces=("x-", "x+", "y-", "y+"),  # where the index is that of the ambient
)
measurement.write(sys.argv[1])
