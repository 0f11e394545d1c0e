"""Cases of the study: one per reconstruction, with the sections of the page that show it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from nerif import __version__
from nerif.forward.deflection import MODELS
from nerif.geometry import Box, Ring
from nerif.reconstruction.device import resolve_device
from nerif.reconstruction.neural.presets import PRESETS, preset
from nerif.reconstruction.neural.training_settings import LossWeights
from nerif.reconstruction.reconstructor import Reconstructor
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation

SECTIONS = {
    "tables": "Correlation and L2 of seven phantoms at three noise levels",
    "slices": "Structural similarity and correlation of ten slices",
    "curves": "Error against time and epochs",
    "cost": "Time and memory",
    "network": "Multi-head and plain networks, with and without the gradient head",
    "encoding": "Octaves of the positional encoding",
    "sampling": "Random against regular sampling",
    "differentiation": "Numerical against automatic differentiation",
    "model": "Forward models: lever_arm, paraxial, curved",
    "resolution": "Spatial resolution",
    "views": "Number of views",
    "speed": "Error against seconds",
}
"""Name for --only, and heading."""

PHANTOMS = ("1", "2", "3", "4", "5", "6", "7")
NOISES = (0.0, 0.1, 0.15)
METHODS = ("NeRIF", "Tikhonov", "Landweber", "TV")
BOX = Box.cube(50.0)


@dataclass(frozen=True)
class Scale:
    """Size of the study.

    Parameters
    ----------
    pixels : of an edge of each view (paper: 200)
    truth_voxels : of the grid of the errors
    seconds : time limit of each NeRIF reconstruction
    steps, points : of training, and sample points of each; 0: no limit, and those of the preset
    voxels : of the grid of Tikhonov and Landweber (paper: 40)
    tv_voxels, tv_basis : of total variation, the most accurate classical method here
    octaves, views : values compared by the sections of those names
    """

    name: str
    pixels: int
    truth_voxels: int
    seconds: float
    voxels: int
    tv_voxels: int
    tv_basis: str
    octaves: tuple[int, ...]
    views: tuple[int, ...]
    steps: int = 0
    points: int = 0
    preset: str = "auto"
    device: str = "auto"


FULL = Scale("full", 200, 100, 120.0, 40, 64, "cubic", (0, 2, 4, 5, 6, 8), (3, 4, 6, 9, 12, 18))
QUICK = Scale("quick", 40, 40, 10.0, 40, 40, "linear", (0, 3, 5, 7), (3, 6, 9, 18), steps=350, points=4096)


@dataclass(frozen=True)
class Case:
    """One reconstruction of the study.

    Parameters
    ----------
    labels : its name in each section that shows it
    noise : as a share of the rms displacement
    truth_voxels : of the grid of the error
    snapshots : whether the error is recorded during the run
    """

    key: str
    labels: dict[str, str]
    phantom: str
    noise: float
    method: str
    reconstructor: Reconstructor
    ring: Ring
    truth_voxels: int
    snapshots: bool = False

    @property
    def data_name(self) -> str:
        """Name of the simulated measurement without noise."""
        ring = self.ring
        return f"{self.phantom}-{ring.views}views-{ring.arc[1]:g}deg-{ring.image_size[0]}px-{__version__}.nc"


def study_cases(scale: Scale) -> list[Case]:
    """Return the reconstructions that the sections need, each once."""
    cases: dict[str, Case] = {}
    for case in _all(scale):
        if case.key in cases:
            case = replace(cases[case.key], labels={**cases[case.key].labels, **case.labels})
        cases[case.key] = case
    return list(cases.values())


def section_keys(scale: Scale, section: str) -> dict[str, str]:
    """Return the keys of the cases of a section by label, in the section's order."""
    return {case.labels[section]: case.key for case in _all(scale) if section in case.labels}


@cache
def _all(scale: Scale) -> tuple[Case, ...]:
    return tuple(_by_section(scale))


def _by_section(scale: Scale) -> Iterator[Case]:
    ring = Ring(image_size=(scale.pixels,) * 2, pixel_pitch=0.02 * 200 / scale.pixels)
    base = preset(scale.preset)
    limits: dict[str, Any] = {"time_limit": scale.seconds, "max_steps": scale.steps, "epochs": 0}
    base = replace(base, **limits, points_per_batch=scale.points or base.points_per_batch, device=scale.device)

    def case(key: str, labels: dict[str, str], reconstructor: Reconstructor, **more: Any) -> Case:
        values = {"phantom": "2", "noise": 0.1, "method": "NeRIF", "ring": ring, "truth_voxels": scale.truth_voxels}
        return Case(key=key, labels=labels, reconstructor=reconstructor, **{**values, **more})

    methods: dict[str, Reconstructor] = {
        "NeRIF": base,
        "Tikhonov": Tikhonov(voxels=scale.voxels, basis="linear", device=scale.device),
        "Landweber": Landweber(voxels=scale.voxels, basis="linear", device=scale.device),
        "TV": TotalVariation(voxels=scale.tv_voxels, basis=scale.tv_basis, device=scale.device),  # type: ignore[arg-type]
    }
    for name, method in methods.items():
        for phantom in PHANTOMS:
            for noise in NOISES:
                sections = ("tables", "slices", "cost", *(("curves",) if phantom == "2" else ()))
                yield case(
                    f"{phantom}-{noise:g}-{name.lower()}", dict.fromkeys(sections, name), method, phantom=phantom,
                    noise=noise, method=name, snapshots=phantom == "2" and name == "NeRIF",
                )  # fmt: skip

    # each section below changes one thing of NeRIF as it stands in the tables; most of them on Phantom 2 at noise 0.1
    as_is, exact = "2-0.1-nerif", "2-0-nerif"
    numerical = LossWeights(numerical=1, automatic=0)
    three = LossWeights(consistency=1, numerical=1, head=1, automatic=0)
    plain, heads = replace(base.network, head_width=0, gradient_head=False), replace(base.network, head_width=64)
    yield case(as_is, {"differentiation": "exact gradient (automatic)"}, base)
    central = {"differentiation": "central differences (numerical)"}
    yield case("numerical", central, replace(base, weights=numerical))
    yield case(as_is if plain == base.network else "plain", {"network": "plain"}, replace(base, network=plain))
    yield case("multi-head", {"network": "multi-head, without gradient head"}, replace(base, network=heads))
    gradient = replace(base, network=replace(heads, gradient_head=True), weights=three)
    yield case("gradient-head", {"network": "multi-head, with gradient head (the paper's)"}, gradient)

    for octaves in scale.octaves:
        key = as_is if octaves == base.network.octaves else f"octaves-{octaves}"
        changed = replace(base, network=replace(base.network, octaves=octaves), wave_pixels=0)
        yield case(key, {"encoding": f"N = {octaves}" if octaves else "no encoding"}, changed)

    for sampling in ("random", "shifted", "regular"):
        key = as_is if sampling == base.sampling else f"sampling-{sampling}"
        yield case(key, {"sampling": sampling}, replace(base, sampling=sampling))

    for i, model in enumerate(MODELS):  # the first is what auto stands for
        key, changed = (f"model-{model}", replace(base, model=model)) if i else (exact, base)
        yield case(key, {"model": model}, changed, noise=0.0)

    for name in ("NeRIF", "Tikhonov"):
        octahedron = {"phantom": "octahedron", "noise": 0.0, "method": name}
        yield case(f"octahedron-{name.lower()}", {"resolution": name}, methods[name], **octahedron)

    for views in scale.views:
        half_circle = replace(ring, views=views, arc=(0.0, 180.0 - 180.0 / views))
        yield case(f"views-{views}", {"views": str(views)}, base, ring=half_circle)

    equal = replace(base, sampling="shifted", samples=(24, 48), sample_jitter=10)  # in equal intervals
    width, batch = base.network.width, base.points_per_batch
    variants = {
        "Adam": replace(base, optimiser="adam"),
        "equal intervals": equal,
        "Adam and equal intervals": replace(equal, optimiser="adam"),
        "central differences": replace(base, weights=numerical),
        "mean length of residuals": replace(base, norm="l2"),
        "float32": replace(base, precision="float32"),
        "half the width": replace(base, network=replace(base.network, width=width // 2)),
        "twice the width": replace(base, network=replace(base.network, width=2 * width)),
        "half the batch": replace(base, points_per_batch=batch // 2),
    }
    if resolve_device(scale.device).type != "cpu":  # a step of the larger presets takes a CPU ten seconds and more
        limits = {"time_limit": base.time_limit, "epochs": 0, "device": base.device, "stop_ratio": 0.0}
        variants = {f"preset {name}": replace(settings, **limits) for name, settings in PRESETS.items()} | variants
    yield case(exact, {"speed": "as it is"}, base, noise=0.0)
    for label, variant in variants.items():
        yield case(f"speed-{label.replace(' ', '-')}", {"speed": label}, variant, noise=0.0, snapshots=True)
