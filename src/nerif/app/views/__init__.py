"""Views of images, measurements, runs and results, and the editors of crops and masks."""
