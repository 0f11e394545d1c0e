"""nerif: refractive index, density and temperature fields in 3-D from background-oriented schlieren pictures.

The nouns and verbs of a notebook are here by name (nerif.Measurement, nerif.simulate), loaded when first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nerif.consistency import check_consistency as check_consistency
    from nerif.conventions import InputError as InputError
    from nerif.evaluation import evaluate as evaluate
    from nerif.evaluation import evaluate_views as evaluate_views
    from nerif.evaluation import evaluate_volume as evaluate_volume
    from nerif.exports import export as export
    from nerif.fields.phantoms import make_phantom as make_phantom
    from nerif.geometry import Box as Box
    from nerif.geometry import Camera as Camera
    from nerif.geometry import Grid as Grid
    from nerif.geometry import Plane as Plane
    from nerif.geometry import Ring as Ring
    from nerif.geometry import paper_rig as paper_rig
    from nerif.measurement import Measurement as Measurement
    from nerif.physics.quantities import GasSettings as GasSettings
    from nerif.physics.quantities import derive as derive
    from nerif.prediction import predict as predict
    from nerif.prediction import reproject as reproject
    from nerif.reconstruction.base import Reconstruction as Reconstruction
    from nerif.reconstruction.landweber import Landweber as Landweber
    from nerif.reconstruction.neural import NeRIF as NeRIF
    from nerif.reconstruction.presets import preset as preset
    from nerif.reconstruction.tikhonov import Tikhonov as Tikhonov
    from nerif.reconstruction.total_variation import TotalVariation as TotalVariation
    from nerif.reprojection import Reprojection as Reprojection
    from nerif.result import ResultDirectory as ResultDirectory
    from nerif.simulation import Simulation as Simulation
    from nerif.simulation import add_noise as add_noise
    from nerif.simulation import simulate as simulate
    from nerif.volume import Volume as Volume
    from nerif.volume import read_volume as read_volume
    from nerif.volume import read_volumes as read_volumes
    from nerif.workflow import Run as Run
    from nerif.workflow import reconstruct_into as reconstruct_into
    from nerif.workflow import write_report as write_report

__version__ = "0.1.0"

_HOMES = {
    "conventions": ("InputError",),
    "geometry": ("Box", "Camera", "Grid", "Plane", "Ring", "paper_rig"),
    "measurement": ("Measurement",),
    "volume": ("Volume", "read_volume", "read_volumes"),
    "exports": ("export",),
    "reprojection": ("Reprojection",),
    "fields.phantoms": ("make_phantom",),
    "physics.quantities": ("GasSettings", "derive"),
    "simulation": ("Simulation", "add_noise", "simulate"),
    "reconstruction.base": ("Reconstruction",),
    "reconstruction.neural": ("NeRIF",),
    "reconstruction.presets": ("preset",),
    "reconstruction.landweber": ("Landweber",),
    "reconstruction.tikhonov": ("Tikhonov",),
    "reconstruction.total_variation": ("TotalVariation",),
    "result": ("ResultDirectory",),
    "prediction": ("predict", "reproject"),
    "evaluation": ("evaluate", "evaluate_views", "evaluate_volume"),
    "consistency": ("check_consistency",),
    "workflow": ("Run", "reconstruct_into", "write_report"),
}
"""Module by module, the names that are here as well; type checkers read the imports above, and a test compares them."""

__all__ = ["__version__", *sorted(name for names in _HOMES.values() for name in names)]


if not TYPE_CHECKING:  # a type checker must not take every name for granted

    def __getattr__(name: str) -> object:
        for module, names in _HOMES.items():
            if name in names:
                import importlib

                globals()[name] = getattr(importlib.import_module(f"nerif.{module}"), name)
                return globals()[name]
        raise AttributeError(f"module 'nerif' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
