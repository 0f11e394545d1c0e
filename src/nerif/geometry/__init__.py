"""Cameras, rays, boxes and grids."""

from nerif.geometry.camera import Camera, Plane
from nerif.geometry.grid import Box, Grid
from nerif.geometry.rays import Rays
from nerif.geometry.rig import Ring, paper_rig

__all__ = ["Box", "Camera", "Grid", "Plane", "Rays", "Ring", "paper_rig"]
