"""The reconstruction methods, by the names of settings files and the command line."""

from __future__ import annotations

from nerif.reconstruction.detail.gaussian_process import GaussianProcess
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import Reconstructor
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.multiplicative import MART, MLEM
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation

__all__ = ["METHODS", "method_name"]

METHODS: dict[str, type[Reconstructor]] = {
    "nerif": NeRIF,
    "tikhonov": Tikhonov,
    "landweber": Landweber,
    "tv": TotalVariation,
    "gp": GaussianProcess,
    "mlem": MLEM,
    "mart": MART,
}


def method_name(reconstructor: Reconstructor) -> str:
    """Return the name of the method of some settings."""
    return next(name for name, kind in METHODS.items() if isinstance(reconstructor, kind))
