"""Names of the models of techniques, in settings and files."""

from __future__ import annotations

__all__ = ["AUTO", "MODELS", "MODEL_NAMES"]

AUTO = "auto"
MODELS: dict[str, tuple[str, ...]] = {
    "deflection": ("lever_arm", "paraxial", "curved"),
    "images": ("lever_arm",),
    "absorption": ("absorbance", "intensity", "poisson"),
}
"""Models of techniques that have several, the default first."""
MODEL_NAMES = (AUTO, *(name for names in MODELS.values() for name in names))
