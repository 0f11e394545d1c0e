"""What the study reconstructs: one Case a reconstruction, and the sections of the page that show it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from nerif import __version__
from nerif.common.conventions import InputError
from nerif.forward.deflection import MODELS
from nerif.geometry import Box, Ring
from nerif.reconstruction.base import Reconstructor
from nerif.reconstruction.device import resolve_device
from nerif.reconstruction.neural.losses import LossWeights
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.presets import PRESETS, preset
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation

__all__ = [
    "BOX",
    "FULL",
    "METHODS",
    "NOISES",
    "NOISE_SEED",
    "N_AMBIENT",
    "PHANTOMS",
    "QUICK",
    "SECTIONS",
    "Case",
    "Scale",
    "cases",
    "check_sections",
]

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
N_AMBIENT = 1.00027
BOX = Box.cube(50.0)
NOISE_SEED = 1
EQUAL = ((24, 48), 10)  # samples and their jitter where intervals are equal


@dataclass(frozen=True)
class Scale:
    """How large the study is.

    Parameters
    ----------
    name : quick or full
    pixels : of an edge of each view (paper: 200)
    truth_voxels : of the grid that errors are taken on
    seconds : of training of each NeRIF reconstruction, at most
    steps, points : of training, and sample points of each; 0 for no such limit, and for as many as the preset has
    voxels : of the grid of Tikhonov and Landweber (paper: 40)
    tv_voxels, tv_basis : of total variation, the best of the classical methods here
    octaves, views : values that the sections of those names compare
    preset : settings that NeRIF starts from, see reconstruction/presets.py
    device : where to compute
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
    key : its name, and that of its file
    labels : what it is called in the sections that show it
    phantom : see fields/phantoms.py
    noise : as a share of the rms displacement
    method : one of METHODS
    reconstructor : with its settings
    ring : the cameras
    truth_voxels : of the grid the error is taken on
    snapshots : whether the error is followed through the run
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
    def data_key(self) -> str:
        """Name of the simulated measurement without noise, with a hash of all that it depends on."""
        ring = dataclasses.asdict(self.ring)
        told = json.dumps([self.phantom, ring, dataclasses.asdict(BOX), N_AMBIENT, __version__])
        return f"phantom{self.phantom}-{self.ring.views}views-{hashlib.sha256(told.encode()).hexdigest()[:12]}"

    def request(self) -> dict[str, Any]:
        """All that is asked for, as it reads back from JSON."""
        plain = dataclasses.asdict(self) | {"box": dataclasses.asdict(BOX), "n_ambient": N_AMBIENT, "seed": NOISE_SEED}
        del plain["labels"], plain["key"]
        return dict(json.loads(json.dumps(plain)))


def check_sections(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the sections asked for, all of them where none is named; an unknown one is an error."""
    for name in names:
        if name not in SECTIONS:
            raise InputError(f"only: expected sections out of {', '.join(SECTIONS)}, got '{name}'")
    return names or tuple(SECTIONS)


def cases(scale: Scale, only: tuple[str, ...] = ()) -> list[Case]:
    """Return the reconstructions that the sections need, each once."""
    wanted = set(check_sections(only))
    found: dict[str, Case] = {}
    for case in _all(scale):
        if case.key in found:
            case = replace(found[case.key], labels={**found[case.key].labels, **case.labels})
        found[case.key] = case
    return [case for case in found.values() if wanted.intersection(case.labels)]


def nerif(scale: Scale, **changes: Any) -> NeRIF:
    """NeRIF as the study runs it: a preset, so many seconds, and what a section changes."""
    base = preset(scale.preset)
    limits = {"time_limit": scale.seconds, "max_steps": scale.steps, "epochs": 0}
    points = scale.points or base.points_per_batch
    return replace(base, **{**limits, "points_per_batch": points, "device": scale.device, **changes})


def _all(scale: Scale) -> Iterator[Case]:
    ring = Ring(image_size=(scale.pixels,) * 2, pixel_pitch=0.02 * 200 / scale.pixels)
    base = nerif(scale)

    def case(key: str, labels: dict[str, str], reconstructor: Reconstructor, **more: Any) -> Case:
        values = {"phantom": "2", "noise": 0.1, "method": "NeRIF", "ring": ring, "truth_voxels": scale.truth_voxels}
        return Case(key=key, labels=labels, reconstructor=reconstructor, **{**values, **more})

    for name, method in {
        "NeRIF": base,
        "Tikhonov": Tikhonov(voxels=scale.voxels, basis="linear", device=scale.device),
        "Landweber": Landweber(voxels=scale.voxels, basis="linear", device=scale.device),
        "TV": TotalVariation(voxels=scale.tv_voxels, basis=scale.tv_basis, device=scale.device),  # type: ignore[arg-type]
    }.items():
        for phantom in PHANTOMS:
            for noise in NOISES:
                shown = ("tables", "slices", "cost", *(("curves",) if phantom == "2" else ()))
                follow = phantom == "2" and name == "NeRIF"
                yield case(
                    f"{phantom}-{noise:g}-{name.lower()}", dict.fromkeys(shown, name), method,
                    phantom=phantom, noise=noise, method=name, snapshots=follow,
                )  # fmt: skip

    # each section below changes one thing of NeRIF as it stands in the tables; most of them on Phantom 2 at noise 0.1
    as_is = "2-0.1-nerif"
    exact, differences = "exact gradient (automatic)", "central differences (numerical)"
    yield case(as_is, {"differentiation": exact}, base)
    numerical = LossWeights(numerical=1, automatic=0)
    yield case("numerical", {"differentiation": differences}, replace(base, weights=numerical))
    plain, heads = replace(base.network, head_width=0, gradient_head=False), replace(base.network, head_width=64)
    key = as_is if plain == base.network else "plain"
    yield case(key, {"network": "plain"}, replace(base, network=plain))
    yield case("multi-head", {"network": "multi-head, without gradient head"}, replace(base, network=heads))
    three = LossWeights(consistency=1, numerical=1, head=1, automatic=0)
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
        key, changed = (f"model-{model}", replace(base, model=model)) if i else ("2-0-nerif", base)
        yield case(key, {"model": model}, changed, noise=0.0)

    tikhonov = Tikhonov(voxels=scale.voxels, basis="linear", device=scale.device)
    for name, method in {"NeRIF": base, "Tikhonov": tikhonov}.items():
        octahedron = {"phantom": "octahedron", "noise": 0.0, "method": name}
        yield case(f"octahedron-{name.lower()}", {"resolution": name}, method, **octahedron)

    for views in scale.views:
        half_circle = replace(ring, views=views, arc=(0.0, 180.0 - 180.0 / views))
        yield case(f"views-{views}", {"views": str(views)}, base, ring=half_circle)

    for label, variant in variants(base, resolve_device(scale.device).type == "cuda").items():
        key = "2-0-nerif" if variant == base else f"speed-{label.replace(' ', '-')}"
        yield case(key, {"speed": label}, variant, noise=0.0, snapshots=True)


def variants(base: NeRIF, gpu: bool) -> dict[str, NeRIF]:
    """What the speed is compared of: as it is, one choice taken back, and on a GPU the presets (a step of the larger
    ones takes a CPU ten seconds and more).
    """

    def limited(settings: NeRIF) -> NeRIF:
        return replace(settings, time_limit=base.time_limit, epochs=base.epochs, device=base.device, stop_ratio=0.0)

    network, (samples, jitter) = base.network, EQUAL
    equal = replace(base, sampling="shifted", samples=samples, sample_jitter=jitter)
    return {
        "as it is": base,
        **({f"preset {name}": limited(settings) for name, settings in PRESETS.items()} if gpu else {}),
        "Adam": replace(base, optimiser="adam"),
        "equal intervals": equal,
        "Adam and equal intervals": replace(equal, optimiser="adam"),
        "central differences": replace(base, weights=LossWeights(numerical=1, automatic=0)),
        "mean length of residuals": replace(base, norm="l2"),
        "float32": replace(base, precision="float32"),
        "half the width": replace(base, network=replace(network, width=network.width // 2)),
        "twice the width": replace(base, network=replace(network, width=2 * network.width)),
        "half the batch": replace(base, points_per_batch=base.points_per_batch // 2),
    }
