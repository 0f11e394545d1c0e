"""Do the views of a measurement agree with one another? And if not, which one is it, and what happened to it?

Each view is predicted by a quick reconstruction from the others. Mistakes that happen (mistakes.py) are undone one at a
time: the one that lets a reconstruction from all views fit clearly better is reported, then looked for another. What
fits equally well either way cannot be found: a flipped sign of everything, a mirrored picture of a symmetric flow.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import FACES
from nerif.fields.base import Field
from nerif.geometry import Grid
from nerif.measurement import Measurement
from nerif.mistakes import Correction, everywhere, exchanges, of_one_view
from nerif.physics.path_integral import PathIntegral
from nerif.prediction import predict_view
from nerif.reconstruction.tikhonov import Tikhonov
from nerif.techniques.deflection import LeverArm

__all__ = ["Consistency", "ViewAgreement", "binned", "check_consistency"]

LONGEST = 48  # px along the longer edge of the pictures that are compared, whatever the size of the sensor
BETTER = 0.97  # a mistake is one if undoing it brings the objective of the joint fit below this share
SHORTLIST = 0.95  # worth a joint fit: undoing it brings the disagreement with the other views below this share
NO_EXCHANGE = 1.15  # two views are not worth a joint fit if they fit each other's prediction so much worse
EXCHANGE = 1.03  # two views are exchanged only if what the other views predict of them does not speak against it
BETTER_EVERYWHERE = 0.8  # and below this if it is to have happened to all views
FEW, BETTER_OF_FEW = 9, 0.9  # with fewer views, neighbours are further apart, and an exchange needs stronger evidence
UNLIKE = 0.5  # a view that agrees less than this share of the median, for no reason that is known
GAIN = 1.6  # a view whose displacements are this many times too large or too small
OPEN = (0.4, 2.0)  # flow goes on beyond a face: what is not explained of rays through it is at least this share of the
# displacement of the others, and this many times theirs as a share of its own. Rays through an end cross a corner of
# the box and carry little: flow that ends at the box leaves a large share of that unexplained, but of a small thing
SPIKE = 6.0  # times the 95th percentile: rays along a sharp edge, which no coarse reconstruction follows


@dataclass(frozen=True)
class ViewAgreement:
    """How well one view agrees with the others.

    Parameters
    ----------
    name : of the view
    valid : share of its pixels that can be used
    agreement : correlation of what is measured with what the other views predict, mistakes that were found undone
    gain : factor by which measured displacements are larger than predicted
    verdict : what is wrong with it, or nothing
    """

    name: str
    valid: float
    agreement: float
    gain: float
    verdict: str


@dataclass(frozen=True)
class Consistency:
    """What was found.

    Parameters
    ----------
    views : agreement of every view; empty if there are too few views to compare
    findings : mistakes, in words
    remarks : what a user should know besides
    """

    views: tuple[ViewAgreement, ...]
    findings: tuple[str, ...]
    remarks: tuple[str, ...]


def check_consistency(
    measurement: Measurement, voxels: int = 24, on_step: Callable[[int, int], None] = lambda done, total: None
) -> Consistency:
    """Compare every view with a quick reconstruction from the others.

    Parameters
    ----------
    measurement : of three views or more; of fewer only the data themselves are looked at
    voxels : of the quick reconstructions, along the longest edge
    on_step : called with the number of reconstructions done, and of those in this round
    """
    small = _without_spikes(binned(measurement, LONGEST))
    pixels = measurement.usable.flatten(1).sum(dim=1).tolist()
    valid = [n / (c.image_size[0] * c.image_size[1]) for n, c in zip(pixels, measurement.cameras, strict=True)]
    remarks = _looks(measurement, small, valid)
    names = small.names
    if len(names) < 3:
        return Consistency((), (), (*remarks, "fewer than three views: they cannot be compared with one another"))
    found: list[Correction] = []
    for _ in range(max(1, len(names) // 2)):
        correction = _most_likely_mistake(small, voxels, on_step)
        if correction is None:
            break
        found.append(correction)
        small = _without(correction, small)
    everything, _ = _fit(small, voxels, 3e-3)
    views, findings = [], [f"{_who(c, names)}: {c.words}" for c in found]
    compared = [_compare(_predict(small, [i], voxels)[i], small, i) for i in range(len(names))]
    middle = float(torch.tensor([a for a, _ in compared]).median())
    oddest = max(range(len(names)), key=lambda i: abs(math.log(max(compared[i][1], 1e-6))))  # it pulls at the others
    for i, (agreement, gain) in enumerate(compared):
        own = [c for c in found if i in c.views and len(c.views) < len(names)]
        verdict = "; ".join(c.words for c in own)
        if not own and agreement < UNLIKE * middle and middle > 0.3 and len(names) > 4:
            verdict = "does not fit the other views: wrong calibration, other flow, or other time?"
        elif not own and i == oddest and not 1 / GAIN < gain < GAIN and agreement > 0.5:
            verdict = (
                f"displacements {gain:.2g} times those that the other views predict: binning, or another lever arm?"
            )
        if verdict and not own:
            findings.append(f"view {names[i]}: {verdict}")
        views.append(ViewAgreement(names[i], valid[i], agreement, gain, verdict))
    if not any(v.verdict for v in views) or found:  # a view that does not fit has rays through every face
        findings += _open_faces(everything, small)
    mean = float(everything.sample(Grid.of_resolution(small.box, voxels)).mean())
    kind = "lighter (hot gas, helium)" if mean < 0 else "denser (cold or heavy gas)"
    remarks.append(f"the flow comes out {kind} than the ambient; if that is wrong, every sign is flipped")
    return Consistency(tuple(views), tuple(findings), tuple(remarks))


def binned(measurement: Measurement, longest: int) -> Measurement:
    """Return the measurement with pixels averaged in squares, so that no picture is longer than about `longest` px.

    Pictures of a few rows keep one, as high as their squares would be or as they are.
    """
    most = -(-max(max(c.image_size) for c in measurement.cameras) // longest)
    down, across = (max(1, min(most, *(c.image_size[i] for c in measurement.cameras))) for i in (0, 1))
    scale = torch.tensor([across, down], dtype=measurement.cameras[0].intrinsics.dtype)
    cameras = []
    for camera in measurement.cameras:
        k = camera.intrinsics.clone()
        k[:2, :2] /= scale[:, None]
        k[:2, 2] = (k[:2, 2] + 0.5) / scale - 0.5
        height, width = camera.image_size
        cameras.append(replace(camera, intrinsics=k, image_size=(height // down, width // across)))
    rows, columns = (n // bins for n, bins in zip(measurement.displacements.shape[1:3], (down, across), strict=True))
    inside = (slice(0, rows * down), slice(0, columns * across))
    maps = []
    for d, usable in zip(measurement.displacements, measurement.usable, strict=True):
        good = usable[inside].reshape(rows, down, columns, across)
        parts = torch.where(good[..., None], d[inside].reshape(rows, down, columns, across, 2), 0.0)
        count = good.sum(dim=(1, 3))[..., None]
        mean = parts.sum(dim=(1, 3)) / count.clamp_min(1) / scale.to(d)
        maps.append(torch.where(count * 2 >= down * across, mean, torch.nan))
    return replace(
        measurement,
        cameras=tuple(cameras),
        displacement=torch.stack(maps),
        sigma=None,
        valid=None,
        flow_mask=None,
    )


def _without_spikes(small: Measurement) -> Measurement:
    length = small.displacements.norm(dim=-1)
    limit = SPIKE * torch.nanquantile(length.flatten()[:: max(1, length.numel() // 1_000_000)], 0.95)
    return replace(small, displacement=torch.where((length <= limit)[..., None], small.displacements, torch.nan))


def _fit(measurement: Measurement, voxels: int, weight: float) -> tuple[Field, float]:
    """A quick reconstruction, and its objective."""
    settings = Tikhonov(
        voxels=voxels, basis="linear", iterations=30, tolerance=1e-3, regularisation=weight, coarse_to_fine=False,
        hull=False, device="cpu",
    )  # fmt: skip
    result = settings(measurement)
    return result.field, float(result.history[-1]["objective"])


def _predict(small: Measurement, left_out: Sequence[int], voxels: int) -> dict[int, Float[Tensor, "row column 2"]]:
    """What the other views predict of those left out."""
    others = [name for i, name in enumerate(small.names) if i not in left_out]
    field, _ = _fit(small.select(others), voxels, 3e-3)
    model = PathIntegral(LeverArm(small.n_ambient))
    return {i: predict_view(field, small.cameras[i], model, small.box) for i in left_out}


def _compare(
    predicted: Float[Tensor, "row column 2"], small: Measurement, view: int, measured: Tensor | None = None
) -> tuple[float, float]:
    """Correlation (about 0) of measured and predicted displacements, and the factor between them."""
    height, width = small.cameras[view].image_size
    measured = (small.displacements[view] if measured is None else measured)[:height, :width]
    good = torch.isfinite(measured).all(dim=-1)
    a, b = predicted[good].flatten(), measured[good].flatten()
    product = float((a * b).sum())
    return product / max(float(a.norm() * b.norm()), 1e-30), product / max(float(a.square().sum()), 1e-30)


def _disagreement(predicted: Tensor, small: Measurement, view: int, measured: Tensor) -> float:
    """Share of the displacements that a prediction does not explain: 0 at best, 2 for the opposite."""
    correlation, _ = _compare(predicted, small, view, measured)
    return 1 - correlation * abs(correlation)


def _most_likely_mistake(small: Measurement, voxels: int, on_step: Callable[[int, int], None]) -> Correction | None:
    """The one mistake whose undoing helps the joint fit most, if it helps clearly."""
    views = range(len(small.names))
    d = small.displacements
    alike, done = everywhere(len(views)), 0

    def step(total: int) -> None:
        nonlocal done
        done += 1
        on_step(done, total)

    likely, agreements, predictions = [], [], []
    for i in views:
        predicted = _predict(small, [i], voxels)[i]
        now = _disagreement(predicted, small, i, d[i])
        agreements.append(_compare(predicted, small, i)[0])
        ways = of_one_view(i)
        left = [_disagreement(predicted, small, i, _without(c, small).displacements[i]) for c in ways]
        likely += [c for c, x in zip(ways, left, strict=True) if x < SHORTLIST * now]
        predictions.append(predicted)
        step(2 * len(views))
    likely += [c for c in exchanges(small.cameras) if _crossed(dict(enumerate(predictions)), small, c) < NO_EXCHANGE]
    _, before = _fit(small, voxels, 1e-4)
    results = []
    for correction in [*likely, *alike]:
        results.append((_fit(_without(correction, small), voxels, 1e-4)[1] / before, correction))
        step(len(views) + len(likely) + len(alike))
    enough = UNLIKE * float(torch.tensor(agreements).median())
    for gain, correction in sorted(results, key=lambda r: r[0]):
        if gain > BETTER:
            return None
        if len(correction.views) == len(views) and gain > BETTER_EVERYWHERE:
            continue
        if correction.change is None:
            clear = len(views) >= FEW or gain < BETTER_OF_FEW
            if not clear or _crossed(_predict(small, correction.views, voxels), small, correction) > EXCHANGE:
                continue
        if len(correction.views) == len(views) or _fits(_without(correction, small), correction.views, enough, voxels):
            return correction
    return None


def _fits(mended: Measurement, views: Sequence[int], enough: float, voxels: int) -> bool:
    """Whether views agree with the others once mended; one that does not has something else."""
    predicted = _predict(mended, views, voxels)
    return all(_compare(predicted[i], mended, i)[0] >= enough for i in views)


def _without(correction: Correction, small: Measurement) -> Measurement:
    return replace(small, displacement=correction.undo(small.displacements, small.cameras))


def _crossed(predicted: dict[int, Tensor], small: Measurement, pair: Correction) -> float:
    """Disagreement of two views with predictions of each other, as a share of that with their own."""
    i, j = pair.views
    d = small.displacements
    straight = sum(_disagreement(predicted[k], small, k, d[k]) for k in (i, j))
    crossed = _disagreement(predicted[i], small, i, d[j]) + _disagreement(predicted[j], small, j, d[i])
    return crossed / max(straight, 1e-30)


def _who(correction: Correction, names: Sequence[str]) -> str:
    if len(correction.views) == len(names):
        return "all views"
    return ("views " if len(correction.views) > 1 else "view ") + " and ".join(names[i] for i in correction.views)


def _open_faces(field: Field, small: Measurement) -> list[str]:
    """Faces beyond which the flow seems to go on: rays through them fit worse than rays through none of them."""
    model = PathIntegral(LeverArm(small.n_ambient))
    groups: dict[str, list[Tensor]] = {face: [] for face in (*FACES, "none")}
    suspects = [face for face in FACES if face not in small.ambient_faces]
    for i, camera in enumerate(small.cameras):
        height, width = camera.image_size
        predicted = predict_view(field, camera, model, small.box).reshape(-1, 2)
        measured = small.displacements[i, :height, :width].reshape(-1, 2)
        rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(small.box)
        good = torch.isfinite(measured).all(dim=-1) & rays.crosses
        both = torch.stack([(predicted - measured).square().sum(dim=-1), measured.square().sum(dim=-1)], dim=-1)
        through = {face: rays.exit_faces(small.box, [face]) & good for face in suspects}
        rest = good.clone()
        for face, mask in through.items():
            groups[face].append(both[mask])
            rest &= ~mask
        groups["none"].append(both[rest])
    findings, usual = [], torch.cat(groups["none"])
    for face in suspects:
        own = torch.cat(groups[face])
        if len(own) < 20 or len(usual) < 20:
            continue
        left, left_usual = (float((g[:, 0].sum() / g[:, 1].sum()).sqrt()) for g in (own, usual))
        unexplained = float((own[:, 0].mean() / usual[:, 1].mean()).sqrt())
        if unexplained > OPEN[0] and left > OPEN[1] * left_usual:
            findings.append(
                f"face {face}: {left:.0%} of the displacement of rays through it is not explained, {left_usual:.0%} of "
                f"the others; the flow seems to go on beyond it: give --open-faces {face}, or a larger box"
            )
    return findings


def _looks(measurement: Measurement, small: Measurement, valid: Sequence[float]) -> list[str]:
    """What the displacements themselves tell."""
    remarks = []
    for i, name in enumerate(measurement.names):
        if valid[i] < 0.5:
            remarks.append(f"view {name}: only {valid[i]:.0%} of its pixels can be used")
        rows, columns = small.cameras[i].image_size
        d = small.displacements[i, :rows, :columns]
        rim = torch.ones(rows, columns, dtype=torch.bool)
        edge = max(1, min(rows, columns) // 12)
        down = slice(edge, -edge) if rows > 2 * edge else slice(None)  # a line has two ends and no rim
        rim[down, edge:-edge] = False
        rim &= torch.isfinite(d).all(dim=-1)
        inner = d[torch.isfinite(d).all(dim=-1)]
        if int(rim.sum()) < 20:
            continue
        offset, spread = d[rim].median(dim=0).values, d[rim].std(dim=0)
        rms = inner.square().mean().sqrt()
        if float(offset.norm()) > 0.5 * float(rms) and bool((offset.abs() > 2 * spread).any()):
            u, v = (float(x) * measurement.cameras[i].image_size[1] / columns for x in offset)
            remarks.append(
                f"view {name}: its rim is displaced by ({u:.2f}, {v:.2f}) px as a whole; did the camera move? "
                "nerif displacement --shake-border removes it"
            )
    return remarks
