"""Settings of `nerif reconstruct`: those of every method, and a record for each method with its own beside them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from nerif.cli.commands.settings import Flat, Settings
from nerif.reconstruction.base import Reconstructor
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.multiplicative import MART, MLEM
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.workflow.pipeline import Run

__all__ = ["RECORDS", "Reconstruct", "ReconstructNeRIF"]


@dataclass(frozen=True)
class Reconstruct(Settings):
    """Reconstruct the refractive-index field of a measurement and write a result directory."""

    measurement: Annotated[Path, tyro.conf.Positional]
    """Measurement file (.nc); with --resume it may be left out."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Result directory to write."""
    method: str = "nerif"
    """One of nerif, tikhonov, landweber, tv, mlem, mart; --method NAME --help tells the options of each."""
    force: bool = False
    """Overwrite an existing result directory."""
    resume: bool = False
    """Go on with an interrupted run in --out; limits such as --epochs or --iterations may be raised."""
    tensorboard: bool = False
    """Write TensorBoard scalars to OUT/tensorboard."""
    live: bool = False
    """Write OUT/live.json and OUT/live.npz while it goes on, to be looked at (nerif app)."""
    run: Annotated[Run, Flat] = field(default_factory=Run)
    reconstructor: Annotated[Reconstructor, tyro.conf.Suppress] = field(default_factory=NeRIF)

    @property
    def volume_voxels(self) -> int | None:
        """Voxels of the written volume along the longest edge of the box; None for those of the method."""
        return getattr(self, "voxels", None)

    @property
    def kept(self) -> dict[str, Any]:
        """What run.toml keeps beside the settings of run and method."""
        return {"preset": getattr(self, "preset", None), "tensorboard": self.tensorboard}


@dataclass(frozen=True)
class ReconstructNeRIF(Reconstruct):
    """Reconstruct the refractive-index field of a measurement by a neural field and write a result directory."""

    preset: str = "auto"
    """One of fast, best, paper; auto is best where there is a GPU, else fast. Single settings below win over it."""
    voxels: int = 100
    """Voxels of the written volume along the longest edge of the box."""
    reconstructor: Annotated[NeRIF, Flat] = field(default_factory=NeRIF)


@dataclass(frozen=True)
class ReconstructTikhonov(Reconstruct):
    """Reconstruct the refractive-index field of a measurement by Tikhonov regularisation on voxels."""

    method: str = "tikhonov"
    reconstructor: Annotated[Tikhonov, Flat] = field(default_factory=Tikhonov)


@dataclass(frozen=True)
class ReconstructLandweber(Reconstruct):
    """Reconstruct the refractive-index field of a measurement by Landweber iteration on voxels."""

    method: str = "landweber"
    reconstructor: Annotated[Landweber, Flat] = field(default_factory=Landweber)


@dataclass(frozen=True)
class ReconstructTotalVariation(Reconstruct):
    """Reconstruct the refractive-index field of a measurement by total variation on voxels."""

    method: str = "tv"
    reconstructor: Annotated[TotalVariation, Flat] = field(default_factory=TotalVariation)


@dataclass(frozen=True)
class ReconstructMLEM(Reconstruct):
    """Reconstruct a field that is never negative from its line integrals by maximum likelihood (MLEM) on voxels."""

    method: str = "mlem"
    reconstructor: Annotated[MLEM, Flat] = field(default_factory=MLEM)


@dataclass(frozen=True)
class ReconstructMART(Reconstruct):
    """Reconstruct a field that is never negative from its line integrals by MART on voxels."""

    method: str = "mart"
    reconstructor: Annotated[MART, Flat] = field(default_factory=MART)


RECORDS: dict[str, type[Reconstruct]] = {
    kind.method: kind
    for kind in (
        ReconstructNeRIF, ReconstructTikhonov, ReconstructLandweber, ReconstructTotalVariation, ReconstructMLEM,
        ReconstructMART,
    )
}  # fmt: skip
"""By the name that --method has for them."""
