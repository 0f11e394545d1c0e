"""Consistency of the views of a measurement: does each agree with the others, and if not, what is wrong with it?

Each view is predicted by a quick reconstruction from the others. Common mistakes (components swapped, signs, mirrored
or exchanged images, ...) are undone one at a time; the one whose removal clearly improves a fit to all views is
reported, then the next is searched. What fits equally well either way cannot be detected: all signs flipped, or a
mirrored image of a symmetric flow.

Where most views are not predicted at all, the rig as a whole is wrong. The limit is a share of the correlation of
neighbouring pixels, which noise lowers alike. Common errors of calibrations (geometry/plausibility.py) and images under
the names of other cameras are undone one at a time, and the one that restores agreement is the likely cause.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.analysis.prediction import predict_view
from nerif.common.conventions import FACES, InputError
from nerif.common.findings import Finding
from nerif.data.measurement import Measurement, Observation, integrals_of, measurement_of
from nerif.data.volume import INDEX
from nerif.fields.base import Field
from nerif.forward.base import ForwardModel
from nerif.forward.path_integral import PathIntegral
from nerif.forward.registry import forward_model
from nerif.geometry import Camera, Grid
from nerif.geometry.plausibility import rig_findings, suspects
from nerif.reconstruction.aperture import seen_through
from nerif.reconstruction.device import on_free_cores
from nerif.reconstruction.gauge import ambient_faces
from nerif.reconstruction.voxels.tikhonov import Tikhonov

__all__ = [
    "NOISY",
    "Consistency",
    "Correction",
    "ViewAgreement",
    "binned",
    "check_consistency",
    "compare",
    "corrected",
    "disagreement",
    "everywhere",
    "exchanges",
    "fit",
    "looks",
    "of_one_view",
    "open_faces",
    "orders",
    "path_integral",
    "predicted_by_others",
    "repeatable",
    "unrelated",
    "unrelated_finding",
    "values_of",
    "with_values",
    "without_spikes",
]

LITTLE = 0.2  # of what pixels agree with their neighbours: correct rigs reach 0.38 and more, wrong ones at most 0.15
ENOUGH = 0.35  # of the same, that views reach without the likely cause
NOISY = 0.3  # agreement of neighbouring pixels below which noise hides whether views agree
SAME = 0.02  # of agreement, which tells no cause from another
JUDGES = 3  # views by which a cause is judged


def repeatable(small: Measurement) -> float:
    """Return the correlation (about 0) of neighbouring pixels, median over the views: 0 of white noise alone."""
    found = []
    for values, camera in zip(values_of(small), small.cameras, strict=True):
        height, width = camera.image_size
        d = values[:height, :width]
        along = 0 if width < 2 else 1
        a, b = d.narrow(along, 0, d.shape[along] - 1), d.narrow(along, 1, d.shape[along] - 1)
        both = torch.isfinite(a).all(dim=-1) & torch.isfinite(b).all(dim=-1)
        size = float(a[both].norm() * b[both].norm())
        found.append(float((a[both] * b[both]).sum()) / size if size > 0 else 0.0)
    return float(torch.tensor(found).median())


def unrelated(agreements: Sequence[float], small: Measurement) -> bool:
    """Return whether the views have nothing to do with one another, and it is not noise that hides it."""
    most = repeatable(small)
    return most > NOISY and float(torch.tensor(agreements).median()) < LITTLE * most


def unrelated_finding(
    small: Measurement, agreements: Sequence[float], voxels: int, suspicious: Sequence[int] = (),
    on_step: Callable[[int, int], None] = lambda done, total: None,
) -> Finding:  # fmt: skip
    """Say that no view is predicted by the others, and why that is likely so.

    Parameters
    ----------
    small : the measurement, binned
    agreements : of its views
    voxels : of the quick reconstructions, along the longest edge
    suspicious : numbers of the cameras that cannot be where they are; all may be wrong where there are none
    on_step : called with the number of causes tried, and of all
    """
    trials = _trials(small, suspicious)
    best, words = 0.0, ""
    for number, (suspected, trial) in enumerate(trials):
        with suppress(InputError):  # not a rig to reconstruct from either
            reached = _agreement(trial, voxels)
            if reached > best + SAME:  # of two that explain as much, the more common one
                best, words = reached, suspected
        on_step(number + 1, len(trials))
    if best > ENOUGH * repeatable(small):
        cause = f"likely {words}: without that the agreement is {best:.2f}"
    else:
        cause = "check units (mm), poses (world to camera), and whether each image has the camera of its name"
    now = float(torch.tensor(agreements).median())
    sentence = f"no view is predicted by the others (agreement {now:.2f}, median of {len(agreements)}): {cause}"
    return Finding("unrelated", sentence, small.names)


def _trials(small: Measurement, suspicious: Sequence[int]) -> list[tuple[str, Measurement]]:
    """The measurement without each of the likely causes."""
    trials = []
    for suspect, cameras, box in suspects(small.cameras, small.box, suspicious or None):
        with suppress(InputError):
            trials.append((suspect.words, replace(small, cameras=cameras, box=box)))
    for correction in orders(small.cameras):
        trials.append((correction.words, with_values(small, correction.undo(values_of(small), small.cameras))))
    return trials


def _agreement(small: Measurement, voxels: int) -> float:
    """The median agreement of a few views with the others."""
    step = -(-len(small.names) // JUDGES)
    judges = range(0, len(small.names), step)
    reached = [compare(predicted_by_others(small, [i], voxels)[i], small, i)[0] for i in judges]
    return float(torch.tensor(reached).median())


OF_GRADIENTS, OF_INTEGRALS = 3e-3, 3e-4  # weights with which withheld views are predicted at their size, to about 10 %
SPIKE = 6.0  # times the 95th percentile: rays along a sharp edge, which no coarse reconstruction follows


def values_of(small: Measurement) -> Float[Tensor, "view row column c"]:
    """Return what was measured."""
    return small.observations[0].values


def with_values(small: Measurement, values: Float[Tensor, "view row column c"]) -> Measurement:
    """Return the measurement with other values."""
    return small.observed({small.observations[0].technique.name: values})


def path_integral(small: Measurement) -> PathIntegral:
    """Return what the technique sees of a field."""
    return PathIntegral(forward_model(small.observations[0].technique, small))


def binned(measurement: Measurement, longest: int) -> Measurement:
    """Return the measurement with pixels averaged in squares, so that no image is longer than about `longest` px.

    Images of a few rows keep one, as high as their squares would be or as they are. A square counts if half of its
    pixels do; of a view so sparse that none would, if one does. Sigma and masks are left behind.
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
    rows, columns = (n // bins for n, bins in zip(measurement.shape[1:], (down, across), strict=True))
    inside = (slice(0, rows * down), slice(0, columns * across))
    seen = measurement.observations[0]
    pixels = scale if seen.technique.in_pixels() else torch.ones(1)
    maps = []
    for values, usable in zip(seen.values, measurement.usable, strict=True):
        good = usable[inside].reshape(rows, down, columns, across)
        parts = torch.where(good[..., None], values[inside].reshape(rows, down, columns, across, -1), 0.0)
        count = good.sum(dim=(1, 3))[..., None]
        mean = parts.sum(dim=(1, 3)) / count.clamp_min(1) / pixels.to(values)
        mean = mean if seen.signed else mean.clamp_min(0)  # below it is noise, which without sigma would be refused
        enough = count * 2 >= down * across
        maps.append(torch.where(enough if bool(enough.any()) else count > 0, mean, torch.nan))
    return measurement_of(
        {seen.technique: torch.stack(maps)}, cameras, measurement.box, measurement.n_ambient, measurement.wavelength_nm,
        measurement.ambient_faces,
    )  # fmt: skip


def without_spikes(small: Measurement) -> Measurement:
    """Return the measurement without the few pixels whose value is far beyond all others that are not 0."""
    values = values_of(small)
    length = values.norm(dim=-1)
    some = length[length > 0]
    if not len(some):
        return small
    limit = SPIKE * torch.quantile(some[:: max(1, len(some) // 1_000_000)], 0.95)
    return with_values(small, torch.where((length <= limit)[..., None], values, torch.nan))


def fit(measurement: Measurement, voxels: int, weight: float = 0.0) -> tuple[Field, float]:
    """Return a quick reconstruction, and its objective; of weight 0 smooth enough to predict other views well."""
    weight = weight or (OF_GRADIENTS if measurement.observations[0].technique.gauge else OF_INTEGRALS)
    settings = Tikhonov(
        voxels=voxels, basis="linear", iterations=20, tolerance=1e-3, regularisation=weight, coarse_to_fine=False,
        hull=False, device="cpu",
    )  # fmt: skip
    result = settings(measurement)
    return result.field, float(result.history[-1]["objective"])


def predicted_by_others(
    small: Measurement, left_out: Sequence[int], voxels: int
) -> dict[int, Float[Tensor, "row column c"]]:
    """Return what the other views predict of those left out."""
    others = [name for i, name in enumerate(small.names) if i not in left_out]
    field, _ = fit(small.select(others), voxels)
    return {i: predict_view(field, small.cameras[i], path_integral(small), small.box) for i in left_out}


def compare(
    predicted: Float[Tensor, "row column c"], small: Measurement, view: int, measured: Tensor | None = None
) -> tuple[float, float]:
    """Return the correlation (about 0) of what is measured and predicted, and the factor between them."""
    height, width = small.cameras[view].image_size
    measured = (values_of(small)[view] if measured is None else measured)[:height, :width]
    good = torch.isfinite(measured).all(dim=-1)
    a, b = predicted[good].flatten(), measured[good].flatten()
    product = float((a * b).sum())
    return product / max(float(a.norm() * b.norm()), 1e-30), product / max(float(a.square().sum()), 1e-30)


def disagreement(predicted: Tensor, small: Measurement, view: int, measured: Tensor) -> float:
    """Return the share of what is measured that a prediction does not explain: 0 at best, 2 for the opposite."""
    correlation, _ = compare(predicted, small, view, measured)
    return 1 - correlation * abs(correlation)


OPEN = (0.4, 2.0)  # flow goes on beyond a face: what is not explained of rays through it is at least this share of what
# the others measured, and this many times theirs as a share of its own. Rays through an end cross a corner of the box
# and carry little: flow that ends at the box leaves a large share of that unexplained, but of a small thing
FEWEST = 20  # rays of which something can be said


def open_faces(field: Field, small: Measurement) -> list[Finding]:
    """Return a finding for each face beyond which the flow seems to go on: rays through it fit worse than others.

    The others are those through faces known to be ambient alone. Where no face is, they are those not through this one
    nor through one that was found; the worst face comes first.
    """
    what, known = small.observations[0].technique.measured, ambient_faces(small)
    squares, through = _through_faces(field, small)
    suspects = [face for face in FACES if face not in known]
    ambient, left = torch.ones(len(squares), dtype=torch.bool), torch.ones(len(squares), dtype=torch.bool)
    for face in suspects:
        ambient &= ~through[face]
    found = {}
    for face in sorted(suspects, key=lambda face: -_unexplained(squares[through[face]])):
        own, usual = squares[through[face] & left], squares[ambient if known else ~through[face] & left]
        if len(own) < FEWEST or len(usual) < FEWEST:
            continue
        share, share_usual = _unexplained(own), _unexplained(usual)
        size = float((own[:, 0].mean() / (usual if known else squares[left])[:, 1].mean()).sqrt())
        if size > OPEN[0] and share > OPEN[1] * share_usual:
            left &= ~through[face]
            found[face] = Finding(
                "open_face",
                f"face {face}: {share:.0%} of the {what} of rays through it is not explained, {share_usual:.0%} of "
                f"the others; the flow seems to go on beyond it: give --open-faces {face}, or a larger box",
            )
    return [found[face] for face in suspects if face in found]


def _through_faces(field: Field, small: Measurement) -> tuple[Float[Tensor, "n 2"], dict[str, Bool[Tensor, " n"]]]:
    """Of every ray that measured something the squares of what is not explained, and of it all; and its faces."""
    model, channels = path_integral(small), values_of(small).shape[-1]
    squares: list[Tensor] = []
    through: dict[str, list[Tensor]] = {face: [] for face in FACES}
    for i, camera in enumerate(small.cameras):
        height, width = camera.image_size
        predicted = predict_view(field, camera, model, small.box).reshape(-1, channels)
        measured = values_of(small)[i, :height, :width].reshape(-1, channels)
        rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(small.box)
        good = torch.isfinite(measured).all(dim=-1) & rays.crosses
        both = torch.stack([(predicted - measured).square().sum(dim=-1), measured.square().sum(dim=-1)], dim=-1)
        squares.append(both[good])
        for face in FACES:
            through[face].append(rays.exit_faces(small.box, [face])[good])
    return torch.cat(squares), {face: torch.cat(masks) for face, masks in through.items()}


def _unexplained(squares: Float[Tensor, "n 2"]) -> float:
    """The share of what rays measured that is not explained, 0 where they measured nothing."""
    lost, all_of_it = squares.sum(dim=0).tolist()
    return math.sqrt(lost / all_of_it) if all_of_it > 0 else 0.0


def looks(measurement: Measurement, small: Measurement, valid: Sequence[float]) -> list[str]:
    """Return what the maps themselves tell."""
    remarks, kind = [], measurement.observations[0].technique
    for i, name in enumerate(measurement.names):
        if valid[i] < 0.5:
            remarks.append(f"view {name}: only {valid[i]:.0%} of its pixels can be used")
        rows, columns = small.cameras[i].image_size
        d = values_of(small)[i, :rows, :columns]
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
            remarks.append(f"view {name}: {_of_rim(kind, offset, measurement.cameras[i].image_size[1] / columns)}")
    return remarks


def _of_rim(kind: type[ForwardModel], offset: Tensor, shrunk: float) -> str:
    """What a rim says that is not at rest, in images that were shrunk."""
    if kind.background:
        u, v = (float(x) * shrunk for x in offset)
        moved = f"its rim is displaced by ({u:.2f}, {v:.2f}) px as a whole; did the camera move?"
        return f"{moved} nerif displacement --shake-border removes it"
    value = f"its rim shows {kind.measured} {float(offset[0]):.3g} as a whole"
    return f"{value}; if nothing but the ambient is there, subtract it as the offset of the background"


SORTED = "images and cameras were sorted differently, one by numbers (2, 10), the other by letters (10, 2)"
REVERSED = "images and cameras are in opposite order"

View = Callable[[Tensor], Tensor]  # (row, column, channel) to the same


@dataclass(frozen=True)
class Change:
    """What may have happened to a view.

    Parameters
    ----------
    code : of its Finding
    words : for people
    undo : the change that undoes it
    everywhere : its name if all views have it; empty if that cannot be detected
    square : whether it can happen to square images only
    """

    code: str
    words: str
    undo: View
    everywhere: str = ""
    square: bool = False


def _signs(u: float, v: float) -> View:
    return lambda d: d * d.new_tensor([u, v])


MIRRORED, UPSIDE_DOWN = "the image is mirrored left to right", "the image is upside down, mirrored top to bottom"
TURNED = "the image is turned by 180 degrees"

TRANSPOSED, QUARTER = "the image is transposed (rows and columns exchanged)", "the image is turned by 90 degrees"


def _vectors_of(image: View, u: float, v: float) -> View:
    """Undo what happened to an image whose rows became columns: its vectors have the axes exchanged, and signs."""
    return lambda d: _signs(u, v)(image(d).flip(-1))


OF_VECTORS = (
    Change("swapped", "u and v are swapped", lambda d: d.flip(-1), "u and v are swapped"),
    Change("flipped", "the sign of the displacement is flipped (is it the optical flow, which is -d?)", _signs(-1, -1)),
    Change("flipped_u", "the sign of u is flipped", _signs(-1, 1)),
    # of either component it looks alike, but for the sign of the field
    Change("flipped_v", "the sign of v is flipped", _signs(1, -1), "the sign of one component, u or v, is flipped"),
    Change("mirrored", MIRRORED, lambda d: _signs(-1, 1)(d.flip(1)), MIRRORED),
    Change("reversed_columns", "the columns are reversed", lambda d: d.flip(1)),
    Change("upside_down", UPSIDE_DOWN, lambda d: _signs(1, -1)(d.flip(0)), UPSIDE_DOWN),
    Change("reversed_rows", "the rows are reversed", lambda d: d.flip(0)),
    Change("turned", TURNED, lambda d: -d.flip(0, 1)),
    Change("transposed", TRANSPOSED, _vectors_of(lambda d: d.transpose(0, 1), 1, 1), TRANSPOSED, square=True),
    Change("reversed_axes", "rows and columns are exchanged, not u and v", lambda d: d.transpose(0, 1), square=True),
    Change("quarter_turn", QUARTER, _vectors_of(lambda d: d.rot90(1, (0, 1)), 1, -1), square=True),
    Change("quarter_turn", QUARTER, _vectors_of(lambda d: d.rot90(-1, (0, 1)), -1, 1), square=True),
)
"""Of maps with two components in the image."""

OF_SCALARS = (
    Change("mirrored", MIRRORED, lambda d: d.flip(1), MIRRORED),
    Change("upside_down", UPSIDE_DOWN, lambda d: d.flip(0), UPSIDE_DOWN),
    Change("turned", TURNED, lambda d: d.flip(0, 1)),
    Change("transposed", TRANSPOSED, lambda d: d.transpose(0, 1), TRANSPOSED, square=True),
    Change("quarter_turn", QUARTER, lambda d: d.rot90(1, (0, 1)), square=True),
    Change("quarter_turn", QUARTER, lambda d: d.rot90(-1, (0, 1)), square=True),
)
"""Of maps with one number a pixel."""

SIGN = Change("flipped", "the sign is flipped", lambda d: -d)
"""Of one value per pixel that may be negative. A flipped sign of all values cannot be detected."""


@dataclass(frozen=True)
class Correction:
    """What is wrong with which views.

    Parameters
    ----------
    views : indices
    code : of its Finding
    words : for people
    change : what undoes it in each of them; None where images have the places of others
    order : of each of these views then, the number under which its image is
    """

    views: tuple[int, ...]
    code: str
    words: str
    change: View | None
    order: tuple[int, ...] = ()

    def undo(self, d: Tensor, cameras: Sequence[Camera]) -> Tensor:
        """Return values (view, row, column, channel) without the mistake; each view has its own size."""
        d = d.clone()
        if self.change is None:
            d[list(self.views)] = d[list(self.order)]
            return d
        for i in self.views:
            height, width = cameras[i].image_size
            d[i, :height, :width] = self.change(d[i, :height, :width].clone())
        return d


def _changes(observation: Observation, cameras: Sequence[Camera]) -> list[Change]:
    """What may have happened to the images of these cameras."""
    changes = OF_VECTORS if len(observation.technique.channels) == 2 else OF_SCALARS
    if len(observation.technique.channels) == 1 and observation.signed:
        changes = (*changes, SIGN)
    square = all(height == width for height, width in (c.image_size for c in cameras))
    return [change for change in changes if square or not change.square]


def of_one_view(view: int, observation: Observation, cameras: Sequence[Camera]) -> list[Correction]:
    """Everything that may be wrong with one view alone."""
    return [Correction((view,), c.code, c.words, c.undo) for c in _changes(observation, [cameras[view]])]


def exchanges(cameras: Sequence[Camera]) -> list[Correction]:
    """Every two views of one image size that may be exchanged."""
    sizes = [c.image_size for c in cameras]
    pairs = [(j, i) for i in range(len(sizes)) for j in range(i) if sizes[i] == sizes[j]]
    return [Correction(pair, "exchanged", "these two views are exchanged", None, pair[::-1]) for pair in pairs]


def orders(cameras: Sequence[Camera]) -> list[Correction]:
    """Orders in which the images of all views may have been given to the cameras, where their sizes allow it."""
    names, sizes = [c.name for c in cameras], [c.image_size for c in cameras]
    every = tuple(range(len(names)))
    by_number = sorted(every, key=lambda i: [float(word) for word in re.findall(r"\d+(?:\.\d+)?", names[i])])
    by_letter = sorted(every, key=lambda i: names[i])
    there, back = dict(zip(by_number, by_letter, strict=True)), dict(zip(by_letter, by_number, strict=True))
    ways = {tuple(there[i] for i in every): SORTED, tuple(back[i] for i in every): SORTED, every[::-1]: REVERSED}
    ways.pop(every, None)
    possible = {order: words for order, words in ways.items() if [sizes[i] for i in order] == sizes}
    return [Correction(every, "reordered", words, None, order) for order, words in possible.items()]


def everywhere(observation: Observation, cameras: Sequence[Camera]) -> list[Correction]:
    """What may be wrong with all views alike."""
    views = tuple(range(len(cameras)))
    changes = _changes(observation, cameras)
    return [Correction(views, c.code, c.everywhere, c.undo) for c in changes if c.everywhere]


LONGEST = 48  # px along the longer edge of the images that are compared, whatever the size of the sensor
BETTER = 0.97  # a mistake is one if undoing it brings the objective of the joint fit below this share
SHORTLIST = 0.95  # worth a joint fit: undoing it brings the disagreement with the other views below this share
NO_EXCHANGE = 1.15  # two views are not worth a joint fit if they fit each other's prediction so much worse
EXCHANGE = 1.03  # two views are exchanged only if what the other views predict of them does not speak against it
BETTER_EVERYWHERE = 0.8  # and below this if it is to have happened to all views
FEW, BETTER_OF_FEW = 9, 0.9  # with fewer views, neighbours are further apart, and an exchange needs stronger evidence
UNLIKE = 0.5  # a view that agrees less than this share of the median, for no reason that is known
GAIN = 1.6  # a view whose values are this many times too large or too small


@dataclass(frozen=True)
class ViewAgreement:
    """How well one view agrees with the others.

    Parameters
    ----------
    name : of the view
    valid : share of its pixels that can be used
    agreement : correlation of what is measured with what the other views predict, mistakes that were found undone
    gain : factor by which measured values are larger than predicted
    verdict : what is wrong with it, or nothing
    measured : what is compared
    """

    name: str
    valid: float
    agreement: float
    gain: float
    verdict: str
    measured: str = "displacement"


@dataclass(frozen=True)
class Consistency:
    """What was found.

    Parameters
    ----------
    views : agreement of every view; empty if there are too few views to compare
    findings : mistakes, the worst first: no view predicted by the others, then the rig, then single views
    remarks : what a user should know besides
    corrections : what undoes the mistakes that can be undone, of each technique by its name (`corrected`)
    """

    views: tuple[ViewAgreement, ...]
    findings: tuple[Finding, ...]
    remarks: tuple[str, ...]
    corrections: Mapping[str, tuple[Correction, ...]] = field(default_factory=dict)


@on_free_cores
def check_consistency(
    measurement: Measurement, voxels: int = 24, on_step: Callable[[int, int], None] = lambda done, total: None,
    aperture: str = "auto",
) -> Consistency:  # fmt: skip
    """Compare every view with a quick reconstruction from the others, technique by technique.

    Parameters
    ----------
    measurement : of three views or more; of fewer only the data themselves are looked at
    voxels : of the quick reconstructions, along the longest edge
    on_step : called with the number of reconstructions done, and of those in this round
    aperture : whether views see through the whole of their lens (seen_through)

    Raises
    ------
    InputError
        If the aperture is "on" and none is known.
    """
    measurement = seen_through(measurement, aperture)
    observations = integrals_of(measurement)
    several = len(observations) > 1
    views: list[ViewAgreement] = []
    rig = rig_findings(measurement.cameras, measurement.box)
    past = {name for finding in rig if finding.code == "beside" for name in finding.views}
    findings: list[Finding] = []
    remarks: list[str] = []
    corrections: dict[str, tuple[Correction, ...]] = {}
    for observation in observations:
        try:
            own = _check(observation, measurement, voxels, on_step, past, [name for f in rig for name in f.views])
        except InputError as error:
            if not rig:
                raise
            remarks.append(f"views were not compared: {error}")
            continue
        of = f"{observation.technique.name}: " if several else ""
        views += own.views
        corrections |= own.corrections
        findings += [replace(finding, sentence=of + finding.sentence) for finding in own.findings]
        remarks += [of + remark for remark in own.remarks]
    hopeless = [finding for finding in findings if finding.code == "unrelated"]
    others = [finding for finding in findings if finding.code != "unrelated"]
    return Consistency(tuple(views), (*hopeless, *rig, *others), tuple(remarks), corrections)


def _check(
    observation: Observation, measurement: Measurement, voxels: int, on_step: Callable[[int, int], None],
    past: Collection[str], suspicious: Collection[str],
) -> Consistency:  # fmt: skip
    """Compare the views of one technique but those that look past the box; cameras of some may be wrong."""
    kind, measurement = observation.technique, observation.alone(measurement)
    seeing = [name for name in measurement.names if name not in past]
    if not seeing:
        return Consistency((), (), ("no view looks at the box: nothing can be compared",))
    measurement = measurement.select(seeing)
    small = without_spikes(binned(measurement, LONGEST))
    pixels = measurement.usable.flatten(1).sum(dim=1).tolist()
    valid = [n / (c.image_size[0] * c.image_size[1]) for n, c in zip(pixels, measurement.cameras, strict=True)]
    remarks = looks(measurement, small, valid)
    names = small.names
    if len(names) < 3:
        return Consistency((), (), (*remarks, "fewer than three views: they cannot be compared with one another"))
    found: list[Correction] = []
    uncorrected = small
    for _ in range(max(1, len(names) // 2)):
        correction = _most_likely_mistake(small, voxels, on_step)
        if correction is None:
            break
        found.append(correction)
        small = _without(correction, small)
    everything, objective = fit(small, voxels)
    if not objective > 0:
        nothing = f"every {kind.measured} of rays through the box is 0: there is nothing to compare"
        return Consistency((), (), (*remarks, nothing))
    views: list[ViewAgreement] = []
    compared = _compared(small, voxels)
    if unrelated([agreement for agreement, _ in compared], small):
        compared = _compared(uncorrected, voxels) if found else compared
        numbers = [i for i, name in enumerate(names) if name in suspicious]
        agreements = [agreement for agreement, _ in compared]
        finding = unrelated_finding(uncorrected, agreements, voxels, numbers, on_step)
        words = "not predicted by the others"
        for name, share, (agreement, gain) in zip(names, valid, compared, strict=True):
            views.append(ViewAgreement(name, share, agreement, gain, words, kind.measured))
        return Consistency(tuple(views), (finding,), tuple(remarks))
    if repeatable(small) < NOISY:
        remarks.append("noise hides most of what was measured, and with it whether the views agree")
    findings = [_finding(c, names) for c in found]
    middle = float(torch.tensor([a for a, _ in compared]).median())
    oddest = max(range(len(names)), key=lambda i: abs(math.log(max(compared[i][1], 1e-6))))  # it pulls at the others
    for i, (agreement, gain) in enumerate(compared):
        own = [c for c in found if i in c.views and len(c.views) < len(names)]
        verdict, code = "; ".join(c.words for c in own), ""
        if not own and agreement < UNLIKE * middle and middle > 0.3 and len(names) > 4:
            verdict, code = "does not fit the other views: wrong calibration, other flow, or other time?", "unlike"
        elif not own and i == oddest and not 1 / GAIN < gain < GAIN and agreement > 0.5:
            verdict = f"{kind.measured} {gain:.2g} times what the other views predict: {kind.misscaled}?"
            code = "misscaled"
        if code:
            findings.append(Finding(code, f"view {names[i]}: {verdict}", (names[i],)))
        views.append(ViewAgreement(names[i], valid[i], agreement, gain, verdict, kind.measured))
    if not any(v.verdict for v in views) or found:  # a view that does not fit has rays through every face
        findings += open_faces(everything, small)
    if kind.quantity == INDEX:
        mean = float(everything.sample(Grid.of_resolution(small.box, voxels)).mean())
        gas = "lighter (hot gas, helium)" if mean < 0 else "denser (cold or heavy gas)"
        remarks.append(f"the flow comes out {gas} than the ambient; if that is wrong, every sign is flipped")
    undone = {kind.name: tuple(found)} if found else {}
    return Consistency(tuple(views), tuple(findings), tuple(remarks), undone)


def _most_likely_mistake(small: Measurement, voxels: int, on_step: Callable[[int, int], None]) -> Correction | None:
    """The one mistake whose undoing helps the joint fit most, if it helps clearly."""
    views = range(len(small.names))
    observation, d = small.observations[0], values_of(small)
    alike, done = [*everywhere(observation, small.cameras), *orders(small.cameras)], 0

    def step(total: int) -> None:
        nonlocal done
        done += 1
        on_step(done, total)

    likely, agreements, predictions = [], [], []
    for i in views:
        predicted = predicted_by_others(small, [i], voxels)[i]
        now = disagreement(predicted, small, i, d[i])
        agreements.append(compare(predicted, small, i)[0])
        ways = of_one_view(i, observation, small.cameras)
        left = [disagreement(predicted, small, i, c.undo(d, small.cameras)[i]) for c in ways]
        likely += [c for c, x in zip(ways, left, strict=True) if x < SHORTLIST * now]
        predictions.append(predicted)
        step(2 * len(views))
    likely += [c for c in exchanges(small.cameras) if _crossed(dict(enumerate(predictions)), small, c) < NO_EXCHANGE]
    _, before = fit(small, voxels, 1e-4)
    if not before > 0:  # nothing was measured
        return None
    results = []
    for correction in [*likely, *alike]:
        gain = fit(_without(correction, small), voxels, 1e-4)[1] / before
        limit = BETTER_EVERYWHERE if len(correction.views) == len(views) else BETTER
        results.append((gain / limit, gain, correction))  # what all views have must gain more than what a few have
        step(len(views) + len(likely) + len(alike))
    enough = UNLIKE * float(torch.tensor(agreements).median())
    for over_limit, gain, correction in sorted(results, key=lambda r: r[0]):
        if over_limit > 1:
            return None
        if correction.change is None and len(correction.views) == 2:
            clear = len(views) >= FEW or gain < BETTER_OF_FEW
            expected = predicted_by_others(small, correction.views, voxels)
            if not clear or _crossed(expected, small, correction) > EXCHANGE:
                continue
        if len(correction.views) == len(views) or _fits(_without(correction, small), correction.views, enough, voxels):
            return correction
    return None


def _fits(mended: Measurement, views: Sequence[int], enough: float, voxels: int) -> bool:
    """Whether views agree with the others once mended; one that does not has something else."""
    predicted = predicted_by_others(mended, views, voxels)
    return all(compare(predicted[i], mended, i)[0] >= enough for i in views)


def _without(correction: Correction, small: Measurement) -> Measurement:
    return with_values(small, correction.undo(values_of(small), small.cameras))


def _crossed(predicted: dict[int, Tensor], small: Measurement, pair: Correction) -> float:
    """Disagreement of two views with predictions of each other, as a share of that with their own."""
    i, j = pair.views
    d = values_of(small)
    straight = sum(disagreement(predicted[k], small, k, d[k]) for k in (i, j))
    crossed = disagreement(predicted[i], small, i, d[j]) + disagreement(predicted[j], small, j, d[i])
    return crossed / max(straight, 1e-30)


def _compared(small: Measurement, voxels: int) -> list[tuple[float, float]]:
    """Agreement and gain of every view with what the others predict of it."""
    return [compare(predicted_by_others(small, [i], voxels)[i], small, i) for i in range(len(small.names))]


def _finding(correction: Correction, names: Sequence[str]) -> Finding:
    views = tuple(names[i] for i in correction.views)
    return Finding(correction.code, f"{Finding.subject(views, len(names))}: {correction.words}", views)


def corrected(measurement: Measurement, found: Consistency) -> Measurement:
    """Return a measurement with the corrections of `found` applied, to sigma and masks as well.

    Images of the pattern are left out: they are not what was corrected.

    Parameters
    ----------
    measurement : that was compared, by one technique beside its images
    found : by check_consistency, of this measurement

    Raises
    ------
    InputError
        If there is nothing that can be undone, or there are several techniques, whose views share their masks.
    """
    observations = integrals_of(measurement)
    if len(observations) > 1:
        names = " and ".join(o.technique.name for o in observations)
        raise InputError(
            f"expected one technique to correct, got {names}; correct each file by itself", field="measurement"
        )
    (observation,) = observations
    corrections = found.corrections.get(observation.technique.name, ())
    if not corrections:
        raise InputError("nothing was found in it that can be undone", field="measurement")
    alone = observation.alone(measurement)
    if alone.names != measurement.names:
        raise InputError(
            "expected that every view measured something, for views are corrected by number", field="measurement"
        )
    for correction in corrections:
        alone = _undone(correction, alone)
    return alone


def _undone(correction: Correction, measurement: Measurement) -> Measurement:
    (own,) = measurement.observations
    cameras, name = measurement.cameras, own.technique.name
    values = correction.undo(own.values, cameras)
    sigma = None if own.sigma is None else correction.undo(own.sigma, cameras).abs()
    channels = own.values.shape[-1]

    def mask(of: Tensor | None) -> Tensor | None:
        """A mask as a map of as many channels, so that it is turned and exchanged likewise."""
        if of is None:
            return None
        alike = of.to(own.values.dtype)[..., None].expand(*of.shape, channels).contiguous()
        return correction.undo(alike, cameras).abs()[..., 0] > 0.5

    mended = measurement.observed({name: values}, {name: sigma})
    return replace(mended, valid=mask(measurement.valid), flow_mask=mask(measurement.flow_mask))
