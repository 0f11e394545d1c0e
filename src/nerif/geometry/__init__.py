"""Cameras, rays, boxes and grids."""

from nerif.geometry.camera import PERSPECTIVE, PROJECTIONS, TELECENTRIC, Camera, Plane, Projection, projection_named
from nerif.geometry.grid import Box, Grid
from nerif.geometry.lens import Lens, LensDiscs, spread_points
from nerif.geometry.rays import BackgroundPoints, Rays
from nerif.geometry.rig import Ring, paper_rig

__all__ = [
    "PERSPECTIVE", "PROJECTIONS", "TELECENTRIC", "BackgroundPoints", "Box", "Camera", "Grid", "Lens", "LensDiscs",
    "Plane", "Projection", "Rays", "Ring", "paper_rig", "projection_named", "spread_points",
]  # fmt: skip
