"""Cameras, rays, boxes and grids."""

from nerif.geometry.camera import Camera, Plane
from nerif.geometry.grid import Box, Grid
from nerif.geometry.rays import BackgroundPoints, Rays
from nerif.geometry.rig import Ring, paper_rig

__all__ = ["BackgroundPoints", "Box", "Camera", "Grid", "Plane", "Rays", "Ring", "paper_rig"]
