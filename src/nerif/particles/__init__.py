"""Tomographic particle imaging: many small bright points, seen by a few cameras at two instants, and their velocity."""
