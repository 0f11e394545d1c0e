"""Settings of `nerif reconstruct`: those of every method, and a record for each method with its own beside them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nerif.commands.settings import Flat, Settings
from nerif.physics.quantities import GasSettings
from nerif.reconstruction.base import Reconstructor
from nerif.reconstruction.landweber import Landweber
from nerif.reconstruction.neural import NeRIF
from nerif.reconstruction.tikhonov import Tikhonov
from nerif.reconstruction.total_variation import TotalVariation
from nerif.reconstruction.voxels import VoxelReconstructor

__all__ = ["METHODS", "Reconstruct", "ReconstructNeRIF"]


@dataclass(frozen=True)
class Reconstruct(Settings):
    """Reconstruct the refractive-index field of a measurement and write a result directory."""

    measurement: Annotated[Path, tyro.conf.Positional]
    """Measurement file (.nc); with --resume it may be left out."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Result directory to write."""
    method: str = "nerif"
    """One of nerif, tikhonov, landweber, tv; --method NAME --help tells the options of each."""
    hold_out: tuple[str, ...] = ()
    """Views kept out of the reconstruction and re-projected from it."""
    start_from: Path | None = None
    """Result directory of another reconstruction in the same box, of any method, to start from."""
    ensemble: int = 0
    """Reconstruct so many times more with other seeds and noise, for mean and standard deviation of every quantity."""
    leave_one_out: bool = False
    """Let each member of the ensemble do without one view, in turn."""
    report: bool = True
    """Write report.html at the end."""
    force: bool = False
    """Overwrite an existing result directory."""
    resume: bool = False
    """Go on with an interrupted run in --out; limits such as --epochs or --iterations may be raised."""
    checkpoint_every: float = 60.0
    """Seconds between checkpoints."""
    tensorboard: bool = False
    """Write TensorBoard scalars to OUT/tensorboard."""
    gas: GasSettings = field(default_factory=GasSettings)
    """What the density is computed for."""
    reconstructor: Annotated[Reconstructor, tyro.conf.Suppress] = field(default_factory=NeRIF)

    @property
    def volume_voxels(self) -> int:
        """Voxels of the written volume along the longest edge of the box."""
        if isinstance(self.reconstructor, VoxelReconstructor):
            return self.reconstructor.voxels
        return int(getattr(self, "voxels", 100))


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


METHODS: dict[str, type[Reconstruct]] = {
    "nerif": ReconstructNeRIF,
    "tikhonov": ReconstructTikhonov,
    "landweber": ReconstructLandweber,
    "tv": ReconstructTotalVariation,
}
