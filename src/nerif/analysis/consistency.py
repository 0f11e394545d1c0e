"""Consistency of the views of a measurement (`nerif check`): does each agree with the others, and if not, why?

For each technique: the maps are binned and inspected by themselves (`image_remarks`). Each view is predicted by a
quick reconstruction from the others (`predicted_by_others`). Common mistakes (swapped components, signs, mirrored or
exchanged images: `Correction`) are undone one at a time; the one whose correction clearly improves a joint fit, by more
than chance gives over all hypotheses tried, is reported, then the next is searched. If no view is predicted by the
others, common errors of whole calibrations (geometry/plausibility.py) are tried instead (`unrelated_finding`). Last,
rays through each face of the box show whether the flow extends beyond it (`open_faces`). Where the images show only a
part of the flow (image_edges.py), nothing is corrected and no single view is accused. `corrected` applies the
corrections.

A mistake that fits as well as the truth cannot be detected: all signs flipped, or a mirrored image of a symmetric flow.
"""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.analysis.image_edges import cut_edges, cut_sentence
from nerif.analysis.prediction import predict_view
from nerif.common.blocks import blocks
from nerif.common.conventions import FACES, InputError
from nerif.common.findings import Finding
from nerif.data.measurement import Measurement, measurement_of
from nerif.data.measurement_data import Observation, integrals_of
from nerif.data.quantity_names import INDEX
from nerif.fields.field import Field
from nerif.forward.forward_model import ForwardModel
from nerif.forward.path_integral import PathIntegral
from nerif.forward.registry import forward_model
from nerif.geometry import Camera, Grid
from nerif.geometry.plausibility import in_one_plane, rig_findings, suspects
from nerif.reconstruction.aperture import apply_aperture
from nerif.reconstruction.device import on_free_cores
from nerif.reconstruction.gauge import ambient_faces
from nerif.reconstruction.voxels.tikhonov import Tikhonov

__all__ = [
    "Change", "Consistency", "Correction", "ViewAgreement", "binned", "check_consistency", "compare", "corrected",
    "everywhere", "fit", "image_remarks", "independent_samples", "of_one_view", "open_faces", "orders",
    "predicted_by_others", "repeatability", "unrelated", "unrelated_finding", "without_spikes",
]  # fmt: skip

MAX_PIXELS = 48  # along the longer edge of the images that are compared
SPIKE = 6.0  # times the 95th percentile: rays along a sharp edge, which no coarse reconstruction resolves
OF_GRADIENTS, OF_INTEGRALS = 3e-3, 3e-4  # regularisation with which withheld views are predicted to about 10 % in size

MAX_OBJECTIVE, MAX_OBJECTIVE_EVERYWHERE = 0.97, 0.8  # of the joint fit, corrected over uncorrected, of one view or all
MAX_DISAGREEMENT = 0.95  # of a view, corrected over uncorrected, that is worth a joint fit
MAX_EXCHANGED, MAX_EXCHANGED_LAST = 1.15, 1.03  # disagreement of two views, exchanged over unexchanged: worth a joint
# fit, and at last, predicted without both
FEW_VIEWS, MAX_OBJECTIVE_FEW, MAX_EXCHANGED_FEW = 9, 0.9, 0.95  # of fewer views, neighbours are further apart: an
# exchange needs more evidence, in the joint fit and predicted without both
CHANCE = 0.05  # probability of a correction by chance, over all hypotheses tried
DISAGREES = 0.5  # agreement of a view over the median, below which it is reported
WRONG_GAIN = 1.6  # factor of the values of a view

UNRELATED = 0.2  # agreement over repeatability: correct rigs reach 0.38 and more, wrong ones at most 0.15
EXPLAINED = 0.35  # of the same, that corrected views reach
MIN_REPEATABILITY = 0.3  # below which noise hides whether views agree
SAME_AGREEMENT = 0.02
TRIAL_VIEWS = 3  # by which a cause is judged

OPEN_FACE = (0.4, 2.0)  # the unexplained rms of rays through an open face over the signal of other rays, and its share
# of their own signal over that share of other rays; rays through an end face cross a corner of the box and carry little
# signal, of which a flow that ends at the box leaves a large share unexplained, but little in all
MIN_RAYS = 20
GROWN, MAX_GROWN = 0.2, 0.6  # a box larger by this, over its longest edge, leaves at most this of what is unexplained


@dataclass(frozen=True)
class ViewAgreement:
    """How well one view agrees with the others."""

    name: str  #: of the view
    valid: float  #: share of its valid pixels
    agreement: float  #: correlation of the measurement, corrected, with the prediction from the other views
    gain: float  #: factor between measured and predicted values
    verdict: str  #: the mistake, if any
    measured: str = "displacement"  #: the quantity compared


@dataclass(frozen=True)
class Consistency:
    """The outcome of a check."""

    views: tuple[ViewAgreement, ...]  #: agreement of every view; empty if there are too few views to compare
    findings: tuple[Finding, ...]  #: mistakes, most severe first: unrelated views, then the rig, then single views
    remarks: tuple[str, ...]  #: further notes
    corrections: Mapping[str, tuple[Correction, ...]] = field(default_factory=dict)
    """Corrections of the mistakes, by the name of the technique (`corrected`)."""


@on_free_cores
def check_consistency(
    measurement: Measurement, voxels: int = 24, on_step: Callable[[int, int], None] = lambda done, total: None,
    aperture: str = "auto",
) -> Consistency:  # fmt: skip
    """Compare every view with a quick reconstruction from the others, for each technique.

    Parameters
    ----------
    measurement : of three views or more; with fewer, only the data themselves are inspected
    voxels : of the quick reconstructions, along the longest edge
    on_step : called with the numbers of finished and of all reconstructions of this round
    aperture : depth of field, as in NeRIF
    """
    measurement = apply_aperture(measurement, aperture)
    observations = integrals_of(measurement)
    rig = rig_findings(measurement.cameras, measurement.box)
    past_box = {name for finding in rig if finding.code == "beside" for name in finding.views}
    suspicious = [name for finding in rig for name in finding.views]
    views: list[ViewAgreement] = []
    findings: list[Finding] = []
    remarks: list[str] = []
    corrections: dict[str, tuple[Correction, ...]] = {}
    for observation in observations:
        try:
            one = _check_technique(observation, measurement, voxels, on_step, past_box, suspicious)
        except InputError as error:
            if not rig:
                raise
            remarks.append(f"views were not compared: {error}")
            continue
        prefix = f"{observation.technique.name}: " if len(observations) > 1 else ""
        views += one.views
        corrections |= one.corrections
        findings += [replace(finding, sentence=prefix + finding.sentence) for finding in one.findings]
        remarks += [prefix + remark for remark in one.remarks]
    if views and (note := in_one_plane(measurement.cameras)):
        remarks.append(note)
    worst = [finding for finding in findings if finding.code == "unrelated"]
    others = [finding for finding in findings if finding.code != "unrelated"]
    return Consistency(tuple(views), (*worst, *rig, *others), tuple(remarks), corrections)


def _check_technique(
    observation: Observation, measurement: Measurement, voxels: int, on_step: Callable[[int, int], None],
    past_box: Collection[str], suspicious: Collection[str],
) -> Consistency:  # fmt: skip
    """Compare the views of one technique, without those that look past the box; cameras of others may be wrong."""
    kind, measurement = observation.technique, observation.alone(measurement)
    names = [name for name in measurement.names if name not in past_box]
    if not names:
        return Consistency((), (), ("no view looks at the box: nothing to compare",))
    measurement = measurement.select(names)
    small = uncorrected = without_spikes(binned(measurement, MAX_PIXELS))
    valid = measurement.valid_share(measurement.observations[0])
    remarks = image_remarks(measurement, small, valid)
    if cut := cut_edges(small, small.observations[0]):
        remarks.insert(0, cut_sentence(small, small.observations[0], cut))
    if len(names) < 3:
        cannot = "fewer than three views: from one instant the check cannot tell whether they show the same flow"
        return Consistency((), (), (*remarks, cannot))
    corrections: list[Correction] = []
    for _ in range(max(1, len(names) // 2)):
        correction, doubt = _most_likely_mistake(small, voxels, on_step)
        if correction is None:
            remarks += [doubt] if doubt else []
            break
        corrections.append(correction)
        small = _undone(correction, small)
    joint, objective = fit(small, voxels)
    if not objective > 0:
        nothing = f"every {kind.measured} of rays through the box is 0: nothing to compare"
        return Consistency((), (), (*remarks, nothing))
    compared = _compared(small, voxels)
    if unrelated([agreement for agreement, _ in compared], small) and (not cut or suspicious):
        compared = _compared(uncorrected, voxels) if corrections else compared
        numbers = [i for i, name in enumerate(names) if name in suspicious]
        finding = unrelated_finding(uncorrected, [agreement for agreement, _ in compared], voxels, numbers, on_step)
        views = [
            ViewAgreement(name, share, agreement, gain, "not predicted by the others", kind.measured)
            for name, share, (agreement, gain) in zip(names, valid, compared, strict=True)
        ]
        return Consistency(tuple(views), (finding,), tuple(remarks))
    if repeatability(small) < MIN_REPEATABILITY:
        remarks.append("the noise is too large to judge whether the views agree")
    findings = [_finding(c, names) for c in corrections]
    median = float(torch.tensor([a for a, _ in compared]).median())
    extreme = max(range(len(names)), key=lambda i: abs(math.log(max(compared[i][1], 1e-6))))  # it affects the others
    views = []
    for i, (agreement, gain) in enumerate(compared):
        mistakes = [c for c in corrections if i in c.views and len(c.views) < len(names)]
        verdict, code = "; ".join(c.words for c in mistakes), ""
        if mistakes or cut:  # what lies outside an image deflects the rays of others
            pass
        elif agreement < DISAGREES * median and median > 0.3 and len(names) > 4:
            verdict = "does not agree with the other views: wrong calibration, other flow, or other time?"
            code = "unlike"
        elif i == extreme and not 1 / WRONG_GAIN < gain < WRONG_GAIN and agreement > 0.5:
            verdict = f"{kind.measured} {gain:.2g} times that predicted by the other views: {kind.misscaled}?"
            code = "misscaled"
        if code:
            findings.append(Finding(code, f"view {names[i]}: {verdict}", (names[i],)))
        views.append(ViewAgreement(names[i], valid[i], agreement, gain, verdict, kind.measured))
    if not cut and (corrections or not any(v.verdict for v in views)):  # a wrong view has rays through every face
        findings += open_faces(joint, small, voxels)
    if kind.quantity == INDEX:
        mean = float(joint.sample(Grid.of_resolution(small.box, voxels)).mean())
        gas = "lighter (hot gas, helium)" if mean < 0 else "denser (cold or heavy gas)"
        remarks.append(f"the flow is {gas} than the ambient; if this is wrong, all signs are flipped")
    return Consistency(
        tuple(views), tuple(findings), tuple(remarks),
        {kind.name: tuple(corrections)} if corrections and not cut else {},
    )  # fmt: skip


# -- binned maps, and what they show by themselves ----------------------------------------------------------------


def _values(small: Measurement) -> Float[Tensor, "view row column c"]:
    return small.observations[0].values


def _with_values(small: Measurement, values: Float[Tensor, "view row column c"]) -> Measurement:
    return small.observed({small.observations[0].technique.name: values})


def binned(measurement: Measurement, max_pixels: int) -> Measurement:
    """Return the measurement with pixels averaged in squares, no image longer than about `max_pixels`.

    Images of few rows keep one row. A square is valid if half of its pixels are; in a view so sparse that none would
    be, if one pixel is. Sigma and masks are dropped.
    """
    edge = -(-max(max(c.image_size) for c in measurement.cameras) // max_pixels)
    down, across = (max(1, min(edge, *(c.image_size[i] for c in measurement.cameras))) for i in (0, 1))
    scale = torch.tensor([across, down], dtype=measurement.cameras[0].intrinsics.dtype)
    cameras = []
    for camera in measurement.cameras:
        k = camera.intrinsics.clone()
        k[:2, :2] /= scale[:, None]
        k[:2, 2] = (k[:2, 2] + 0.5) / scale - 0.5
        height, width = camera.image_size
        cameras.append(replace(camera, intrinsics=k, image_size=(height // down, width // across)))
    observation = measurement.observations[0]
    pixels = scale if observation.technique.in_pixels() else torch.ones(1)
    maps = []
    for values, usable in zip(observation.values, measurement.usable, strict=True):
        good = blocks(usable, down, across)
        parts = torch.where(good[..., None], blocks(values, down, across), 0.0)
        count = good.sum(dim=(1, 3))[..., None]
        mean = parts.sum(dim=(1, 3)) / count.clamp_min(1) / pixels.to(values)
        mean = mean if observation.signed else mean.clamp_min(0)  # negative values are noise, and refused without sigma
        dense = count * 2 >= down * across
        maps.append(torch.where(dense if bool(dense.any()) else count > 0, mean, torch.nan))
    small = measurement_of(
        {observation.technique: torch.stack(maps)}, cameras, measurement.box, measurement.n_ambient,
        measurement.wavelength_nm, measurement.ambient_faces,
    )  # fmt: skip
    return replace(small, ambient_region=measurement.ambient_region)


def without_spikes(small: Measurement) -> Measurement:
    """Return the measurement without the few pixels that far exceed all other non-zero values."""
    values = _values(small)
    length = values.norm(dim=-1)
    nonzero = length[length > 0]
    if not len(nonzero):
        return small
    limit = SPIKE * torch.quantile(nonzero[:: max(1, len(nonzero) // 1_000_000)], 0.95)
    return _with_values(small, torch.where((length <= limit)[..., None], values, torch.nan))


def image_remarks(measurement: Measurement, small: Measurement, valid: Sequence[float]) -> list[str]:
    """Return remarks on views with few valid pixels, or whose border is not at rest."""
    remarks, kind = [], measurement.observations[0].technique
    for i, name in enumerate(measurement.names):
        if valid[i] < 0.5:
            remarks.append(f"view {name}: only {valid[i]:.0%} valid pixels ({kind.data_name()})")
        rows, columns = small.cameras[i].image_size
        d = _values(small)[i, :rows, :columns]
        finite = torch.isfinite(d).all(dim=-1)
        border = torch.ones(rows, columns, dtype=torch.bool)
        edge = max(1, min(rows, columns) // 12)
        down = slice(edge, -edge) if rows > 2 * edge else slice(None)  # the border of a line is its two ends
        border[down, edge:-edge] = False
        border &= finite
        if int(border.sum()) < 20:
            continue
        offset, spread = d[border].median(dim=0).values, d[border].std(dim=0)
        rms = d[finite].square().mean().sqrt()
        if float(offset.norm()) > 0.5 * float(rms) and bool((offset.abs() > 2 * spread).any()):
            focal, binned_focal = (m.cameras[i].intrinsics.diagonal()[:2] for m in (measurement, small))
            remarks.append(f"view {name}: {_of_border(kind, offset, focal / binned_focal)}")
    return remarks


def _of_border(kind: type[ForwardModel], offset: Float[Tensor, " c"], bins: Float[Tensor, 2]) -> str:
    """Describe the values of a border; `bins`: columns and rows in each."""
    if kind.background:
        u, v = (offset * bins.to(offset)).tolist()
        return (
            f"displacement at the border ({u:.2f}, {v:.2f}) px; if the camera moved, nerif displacement "
            "--shake-border removes it"
        )
    value = f"{kind.measured} at the border {float(offset[0]):.3g}"
    return f"{value}; if only the ambient is there, subtract it as the offset of the background"


def repeatability(small: Measurement) -> float:
    """Return the correlation (about 0) of neighbouring pixels, median over the views; 0 for white noise."""
    correlations = []
    for values, camera in zip(_values(small), small.cameras, strict=True):
        height, width = camera.image_size
        d = values[:height, :width]
        axis = 0 if width < 2 else 1
        a, b = d.narrow(axis, 0, d.shape[axis] - 1), d.narrow(axis, 1, d.shape[axis] - 1)
        both = torch.isfinite(a).all(dim=-1) & torch.isfinite(b).all(dim=-1)
        size = float(a[both].norm() * b[both].norm())
        correlations.append(float((a[both] * b[both]).sum()) / size if size > 0 else 0.0)
    return float(torch.tensor(correlations).median())


# -- views predicted by the others --------------------------------------------------------------------------------


def fit(measurement: Measurement, voxels: int, weight: float = 0.0) -> tuple[Field, float]:
    """Return a quick reconstruction and its objective; weight 0 is smooth enough to predict other views well."""
    weight = weight or (OF_GRADIENTS if measurement.observations[0].technique.gauge else OF_INTEGRALS)
    settings = Tikhonov(
        voxels=voxels, basis="linear", iterations=20, tolerance=1e-3, regularisation=weight, coarse_to_fine=False,
        hull=False, device="cpu",
    )  # fmt: skip
    result = settings(measurement)
    return result.field, float(result.history[-1]["objective"])


def _path_integral(small: Measurement) -> PathIntegral:
    return PathIntegral(forward_model(small.observations[0].technique, small))


def _predicted(field: Field, small: Measurement) -> dict[int, Float[Tensor, "row column c"]]:
    """The prediction of every view."""
    model = _path_integral(small)
    return {i: predict_view(field, camera, model, small.box) for i, camera in enumerate(small.cameras)}


def predicted_by_others(
    small: Measurement, withheld: Sequence[int], voxels: int
) -> dict[int, Float[Tensor, "row column c"]]:
    """Return the prediction of withheld views from the others."""
    field, _ = fit(small.select([name for i, name in enumerate(small.names) if i not in withheld]), voxels)
    return {i: predict_view(field, small.cameras[i], _path_integral(small), small.box) for i in withheld}


def compare(
    predicted: Float[Tensor, "row column c"], small: Measurement, view: int, measured: Tensor | None = None
) -> tuple[float, float]:
    """Return the correlation (about 0) of measurement and prediction, and the factor between them."""
    height, width = small.cameras[view].image_size
    measured = (_values(small)[view] if measured is None else measured)[:height, :width]
    good = torch.isfinite(measured).all(dim=-1)
    a, b = predicted[good].flatten(), measured[good].flatten()
    product = float((a * b).sum())
    return product / max(float(a.norm() * b.norm()), 1e-30), product / max(float(a.square().sum()), 1e-30)


def _disagreement(predicted: Tensor, small: Measurement, view: int, measured: Tensor) -> float:
    """The share of the measurement that a prediction does not explain: 0 at best, 2 for the opposite."""
    correlation, _ = compare(predicted, small, view, measured)
    return 1 - correlation * abs(correlation)


def _compared(small: Measurement, voxels: int) -> list[tuple[float, float]]:
    """Agreement and gain of every view."""
    return [compare(predicted_by_others(small, [i], voxels)[i], small, i) for i in range(len(small.names))]


# -- mistakes and their corrections -------------------------------------------------------------------------------

Transform = Callable[[Tensor], Tensor]  # of an image (row, column, channel)


@dataclass(frozen=True)
class Change:
    """A mistake that a view may have."""

    code: str  #: of its Finding
    words: str  #: its description
    undo: Transform  #: the transform that undoes it
    everywhere: str = ""  #: its description if all views have it; empty if that cannot be detected
    square: bool = False  #: whether only square images can have it


def _signs(u: float, v: float) -> Transform:
    return lambda d: d * d.new_tensor([u, v])


def _vectors_of(image: Transform, u: float, v: float) -> Transform:
    """The transform of vectors whose image has rows and columns exchanged."""
    return lambda d: _signs(u, v)(image(d).flip(-1))


MIRRORED, UPSIDE_DOWN = "the image is mirrored left to right", "the image is upside down, mirrored top to bottom"
TURNED, QUARTER = "the image is turned by 180 degrees", "the image is turned by 90 degrees"
TRANSPOSED = "the image is transposed (rows and columns exchanged)"
BY_NUMBER = "the images fit better in numerical order (2 before 10); check file names"
BY_LETTER = "the images fit better in alphabetical order (10 before 2); check file names"
REVERSED = "the images fit better in the opposite order; check file names"

OF_VECTORS = (
    Change("swapped", "u and v are swapped", lambda d: d.flip(-1), "u and v are swapped"),
    Change("flipped", "the sign of the displacement is flipped (is it the optical flow, which is -d?)", _signs(-1, -1)),
    Change("flipped_u", "the sign of u is flipped", _signs(-1, 1)),
    # either component is equivalent, but for the sign of the field
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
"""Changes of maps with two components in the image."""

OF_SCALARS = (
    Change("mirrored", MIRRORED, lambda d: d.flip(1), MIRRORED),
    Change("upside_down", UPSIDE_DOWN, lambda d: d.flip(0), UPSIDE_DOWN),
    Change("turned", TURNED, lambda d: d.flip(0, 1)),
    Change("transposed", TRANSPOSED, lambda d: d.transpose(0, 1), TRANSPOSED, square=True),
    Change("quarter_turn", QUARTER, lambda d: d.rot90(1, (0, 1)), square=True),
    Change("quarter_turn", QUARTER, lambda d: d.rot90(-1, (0, 1)), square=True),
)
"""Changes of maps with one value per pixel."""

SIGN = Change("flipped", "the sign is flipped", lambda d: -d)
"""Change of one value per pixel that may be negative; undetectable in all views at once."""


@dataclass(frozen=True)
class Correction:
    """The correction of a mistake in some views."""

    views: tuple[int, ...]  #: indices
    code: str  #: of its Finding
    words: str  #: description of the mistake
    change: Transform | None  #: transform of each of these views; None where images are exchanged
    order: tuple[int, ...] = ()  #: index of the image of each of these views, where images are exchanged
    evidence: str = ""  #: the agreement gained

    def undo(self, d: Tensor, cameras: Sequence[Camera]) -> Tensor:
        """Return corrected values (view, row, column, channel); each view has its own size."""
        d = d.clone()
        if self.change is None:
            d[list(self.views)] = d[list(self.order)]
            return d
        for i in self.views:
            height, width = cameras[i].image_size
            d[i, :height, :width] = self.change(d[i, :height, :width].clone())
        return d


def _undone(correction: Correction, small: Measurement) -> Measurement:
    return _with_values(small, correction.undo(_values(small), small.cameras))


def _finding(correction: Correction, names: Sequence[str]) -> Finding:
    views = tuple(names[i] for i in correction.views)
    sentence = f"{Finding.subject(views, len(names))}: {correction.words} ({correction.evidence})"
    return Finding(correction.code, sentence, views)


def _changes(observation: Observation, cameras: Sequence[Camera]) -> list[Change]:
    """The mistakes that images of these sizes can have."""
    changes = OF_VECTORS if len(observation.technique.channels) == 2 else OF_SCALARS
    if len(observation.technique.channels) == 1 and observation.signed:
        changes = (*changes, SIGN)
    square = all(height == width for height, width in (c.image_size for c in cameras))
    return [change for change in changes if square or not change.square]


def of_one_view(view: int, observation: Observation, cameras: Sequence[Camera]) -> list[Correction]:
    """Return the possible mistakes of a single view."""
    return [Correction((view,), c.code, c.words, c.undo) for c in _changes(observation, [cameras[view]])]


def everywhere(observation: Observation, cameras: Sequence[Camera]) -> list[Correction]:
    """Return the possible mistakes of all views together."""
    views, changes = tuple(range(len(cameras))), _changes(observation, cameras)
    return [Correction(views, c.code, c.everywhere, c.undo) for c in changes if c.everywhere]


def _exchanges(cameras: Sequence[Camera]) -> list[Correction]:
    """All pairs of views of equal size."""
    sizes = [c.image_size for c in cameras]
    pairs = [(j, i) for i in range(len(sizes)) for j in range(i) if sizes[i] == sizes[j]]
    return [Correction(pair, "exchanged", "these two views are exchanged", None, pair[::-1]) for pair in pairs]


def orders(cameras: Sequence[Camera]) -> list[Correction]:
    """Return the orders in which the images may have been assigned to the cameras, where their sizes allow it."""
    names, sizes = [c.name for c in cameras], [c.image_size for c in cameras]
    every = tuple(range(len(names)))
    by_number = sorted(every, key=lambda i: [float(word) for word in re.findall(r"\d+(?:\.\d+)?", names[i])])
    by_letter = sorted(every, key=lambda i: names[i])
    there, back = dict(zip(by_number, by_letter, strict=True)), dict(zip(by_letter, by_number, strict=True))
    words = {tuple(there[i] for i in every): BY_NUMBER, tuple(back[i] for i in every): BY_LETTER, every[::-1]: REVERSED}
    words.pop(every, None)
    return [
        Correction(every, "reordered", text, None, order)
        for order, text in words.items() if [sizes[i] for i in order] == sizes
    ]  # fmt: skip


def _most_likely_mistake(
    small: Measurement, voxels: int, on_step: Callable[[int, int], None]
) -> tuple[Correction | None, str]:  # fmt: skip
    """The correction that clearly improves the joint fit most, and a doubt: one that chance may explain."""
    views, doubt = range(len(small.names)), ""
    observation, d = small.observations[0], _values(small)
    pairs = _exchanges(small.cameras)
    of_all, done = [*everywhere(observation, small.cameras), *orders(small.cameras)], 0
    hypotheses = len(pairs) + len(of_all)

    def step(total: int) -> None:
        nonlocal done
        done += 1
        on_step(done, total)

    shortlist, predictions = [], {}
    for i in views:
        predictions[i] = predicted = predicted_by_others(small, [i], voxels)[i]
        limit = MAX_DISAGREEMENT * _disagreement(predicted, small, i, d[i])
        changes = of_one_view(i, observation, small.cameras)
        hypotheses += len(changes)
        shortlist += [c for c in changes if _disagreement(predicted, small, i, c.undo(d, small.cameras)[i]) < limit]
        step(2 * len(views))
    shortlist += [c for c in pairs if _exchanged(predictions, small, c) < MAX_EXCHANGED]
    joint, uncorrected = fit(small, voxels, 1e-4)
    if not uncorrected > 0:
        return None, ""
    results = []
    for correction in [*shortlist, *of_all]:
        field, objective = fit(_undone(correction, small), voxels, 1e-4)
        limit = MAX_OBJECTIVE_EVERYWHERE if len(correction.views) == len(views) else MAX_OBJECTIVE
        results.append((objective / uncorrected / limit, objective / uncorrected, correction, field))
        step(len(views) + len(shortlist) + len(of_all))
    agreements = [compare(predictions[i], small, i)[0] for i in views]
    for over_limit, ratio, correction, field in sorted(results, key=lambda r: r[0]):
        if over_limit > 1:
            break
        few, whole = len(views) < FEW_VIEWS, len(correction.views) == len(views)
        if correction.change is None and not whole:
            pair = predicted_by_others(small, correction.views, voxels)
            last = _exchanged(pair, small, correction)
            if last > (MAX_EXCHANGED_FEW if few else MAX_EXCHANGED_LAST) or (few and ratio >= MAX_OBJECTIVE_FEW):
                continue
        trial = _undone(correction, small)
        after = {i: predicted_by_others(trial, [i], voxels)[i] for i in views}
        corrected_agreements = [compare(after[i], trial, i)[0] for i in views]
        least = DISAGREES * float(torch.tensor(agreements).median())
        if min(corrected_agreements[i] for i in correction.views) < least:
            continue
        by_others = likelihood = _log_likelihood(predictions, small, after, trial)
        if not whole:  # the other views hold the field
            joint_fits = _predicted(joint, small), _predicted(field, trial)
            likelihood = max(by_others, _log_likelihood(joint_fits[0], small, joint_fits[1], trial))
        chance = min(1.0, hypotheses * math.exp(-likelihood)) if by_others > 0 else 1.0
        evidence = (
            f"agreement {statistics.fmean(corrected_agreements):.2f} instead of {statistics.fmean(agreements):.2f}; "
            f"probability by chance, with {hypotheses} hypotheses tried, {max(chance, 1e-4):.2g}"
        )
        if chance < CHANCE:
            return replace(correction, evidence=evidence), ""
        subject = Finding.subject([small.names[i] for i in correction.views], len(views))
        doubt = doubt or f"{subject}: cannot tell whether {correction.words} ({evidence})"
    return None, doubt


def _log_likelihood(
    before: Mapping[int, Tensor], small: Measurement, after: Mapping[int, Tensor], trial: Measurement
) -> float:  # fmt: skip
    """The logarithm of the ratio of likelihoods of views after and before a change: sum n/2 log(D / D').

    D is the disagreement of a view, n the number of independent samples of its residual after the change.
    """
    total = 0.0
    for i in range(len(small.names)):
        n = independent_samples(_residual(after[i], trial, i))
        old, new = (_disagreement(p[i], m, i, _values(m)[i]) for p, m in ((before, small), (after, trial)))
        total += 0.5 * n * math.log(max(old, 1e-6) / max(new, 1e-6))
    return total


def _residual(predicted: Float[Tensor, "row column c"], small: Measurement, view: int) -> Float[Tensor, "row column c"]:
    """The residual of a view but for a factor of the prediction; 0 without a measurement."""
    height, width = small.cameras[view].image_size
    gain = compare(predicted, small, view)[1]
    return (_values(small)[view, :height, :width] - gain * predicted).nan_to_num(0.0)


def independent_samples(image: Float[Tensor, "row column c"]) -> float:
    """Return the number of independent samples of an image; of white Gaussian noise the number of its pixels.

    The pixels that carry its energy, times the share of frequencies that do.
    """
    height, width, channels = image.shape
    squares = image.double().square().sum(dim=-1)
    power = torch.fft.fft2(image.double(), s=(2 * height, 2 * width), dim=(0, 1)).abs().square().sum(dim=-1)
    if not bool(squares.any()):
        return 0.0
    pixels, share = squares.sum().square() / squares.square().sum(), power.mean().square() / power.square().mean()
    return float(pixels * share) * (1 + 2 / channels) * (1 + 1 / channels)  # of Gaussian values, and of a periodogram


def _exchanged(predicted: Mapping[int, Tensor], small: Measurement, pair: Correction) -> float:
    """Disagreement of two exchanged views with the predictions, over that of the unexchanged ones."""
    i, j = pair.views
    d = _values(small)
    straight = sum(_disagreement(predicted[k], small, k, d[k]) for k in (i, j))
    crossed = _disagreement(predicted[i], small, i, d[j]) + _disagreement(predicted[j], small, j, d[i])
    return crossed / max(straight, 1e-30)


# -- errors of the whole rig, and of the box ----------------------------------------------------------------------


def unrelated(agreements: Sequence[float], small: Measurement) -> bool:
    """Return whether no view is predicted by the others, though the noise is low enough to judge it."""
    limit = repeatability(small)  # noise lowers both
    return limit > MIN_REPEATABILITY and float(torch.tensor(agreements).median()) < UNRELATED * limit


def unrelated_finding(
    small: Measurement, agreements: Sequence[float], voxels: int, suspicious: Sequence[int] = (),
    on_step: Callable[[int, int], None] = lambda done, total: None,
) -> Finding:  # fmt: skip
    """Return the finding that no view is predicted by the others, with the most likely cause.

    Parameters
    ----------
    small : the measurement, binned
    agreements : of its views
    voxels : of the quick reconstructions, along the longest edge
    suspicious : indices of cameras with impossible poses; none: all may be wrong
    on_step : called with the numbers of tested and of all causes
    """
    trials = _trials(small, suspicious)
    best, cause = 0.0, ""
    for number, (words, trial) in enumerate(trials):
        with suppress(InputError):  # not a valid rig either
            agreement = _agreement(trial, voxels)
            if agreement > best + SAME_AGREEMENT:  # otherwise the earlier, more common cause
                best, cause = agreement, words
        on_step(number + 1, len(trials))
    if best > EXPLAINED * repeatability(small):
        remedy = f"likely {cause}: without that the agreement is {best:.2f}"
    else:
        remedy = "check units (mm), poses (world to camera), and whether each image has the camera of its name"
    median = float(torch.tensor(agreements).median())
    sentence = f"no view is predicted by the others (agreement {median:.2f}, median of {len(agreements)}): {remedy}"
    return Finding("unrelated", sentence, small.names)


def _trials(small: Measurement, suspicious: Sequence[int]) -> list[tuple[str, Measurement]]:
    """The measurement without each of the likely causes."""
    trials = []
    for suspect, cameras, box in suspects(small.cameras, small.box, suspicious or None):
        with suppress(InputError):
            trials.append((suspect.words, replace(small, cameras=cameras, box=box)))
    return trials + [(correction.words, _undone(correction, small)) for correction in orders(small.cameras)]


def _agreement(small: Measurement, voxels: int) -> float:
    """The median agreement of TRIAL_VIEWS views."""
    views = range(0, len(small.names), -(-len(small.names) // TRIAL_VIEWS))
    agreements = [compare(predicted_by_others(small, [i], voxels)[i], small, i)[0] for i in views]
    return float(torch.tensor(agreements).median())


def open_faces(field: Field, small: Measurement, voxels: int = 24) -> list[Finding]:
    """Return a finding for each face beyond which the flow extends: rays through it fit worse than others.

    A box that is larger there must explain them: rays through the ends of thin or sharp flow fit worse, too.

    The others are those through faces known to be ambient only or, without such faces, all that cross neither this
    face nor one already found, the worst first.
    """
    measured, ambient = small.observations[0].technique.measured, ambient_faces(small)
    squares, through = _through_faces(field, small)
    suspect_faces = [face for face in FACES if face not in ambient]
    closed, rest = torch.ones(len(squares), dtype=torch.bool), torch.ones(len(squares), dtype=torch.bool)
    for face in suspect_faces:
        closed &= ~through[face]
    findings, growth = {}, GROWN * max(small.box.edges)
    for face in sorted(suspect_faces, key=lambda face: -_unexplained(squares[through[face]])):
        inside, others = squares[through[face] & rest], squares[closed if ambient else ~through[face] & rest]
        if len(inside) < MIN_RAYS or len(others) < MIN_RAYS:
            continue
        share, share_others = _unexplained(inside), _unexplained(others)
        size = float((inside[:, 0].mean() / (others if ambient else squares[rest])[:, 1].mean()).sqrt())
        if size > OPEN_FACE[0] and share > OPEN_FACE[1] * share_others:
            larger = replace(small, box=small.box.grown([face], growth))
            wider, _ = fit(larger, round(voxels * max(larger.box.edges) / max(small.box.edges)))
            if _unexplained(_through_faces(wider, small, larger)[0][through[face] & rest]) > MAX_GROWN * share:
                continue
            rest &= ~through[face]
            findings[face] = Finding(
                "open_face",
                f"face {face}: {share:.0%} of the {measured} of rays through it is unexplained, {share_others:.0%} for "
                f"other rays; the flow seems to extend beyond it: give --open-faces {face} and "
                f"--extend-open-faces {growth:.2g} (mm), or a larger box",
            )
    return [findings[face] for face in suspect_faces if face in findings]


def _through_faces(
    field: Field, small: Measurement, larger: Measurement | None = None
) -> tuple[Float[Tensor, "n 2"], dict[str, Bool[Tensor, " n"]]]:  # fmt: skip
    """Squares of the residual, of the field in its box, and of the measurement of every valid ray; rays by face."""
    model, channels, box = _path_integral(larger or small), _values(small).shape[-1], (larger or small).box
    squares: list[Tensor] = []
    through: dict[str, list[Tensor]] = {face: [] for face in FACES}
    for i, camera in enumerate(small.cameras):
        height, width = camera.image_size
        predicted = predict_view(field, camera, model, box).reshape(-1, channels)
        measured = _values(small)[i, :height, :width].reshape(-1, channels)
        rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(small.box)
        good = torch.isfinite(measured).all(dim=-1) & rays.crosses
        both = torch.stack([(predicted - measured).square().sum(dim=-1), measured.square().sum(dim=-1)], dim=-1)
        squares.append(both[good])
        for face in FACES:
            through[face].append(rays.exit_faces(small.box, [face])[good])
    return torch.cat(squares), {face: torch.cat(masks) for face, masks in through.items()}


def _unexplained(squares: Float[Tensor, "n 2"]) -> float:
    """The unexplained share of the rms signal; 0 without a signal."""
    residual, signal = squares.sum(dim=0).tolist()
    return math.sqrt(residual / signal) if signal > 0 else 0.0


# -- the corrected measurement ------------------------------------------------------------------------------------


def corrected(measurement: Measurement, consistency: Consistency) -> Measurement:
    """Return a measurement with all corrections applied to values, sigma and masks, without images of the pattern.

    Parameters
    ----------
    measurement : of one technique beside its images
    consistency : the check of this measurement
    """
    observations = integrals_of(measurement)
    if len(observations) > 1:
        names = " and ".join(o.technique.name for o in observations)
        raise InputError(f"expected one technique to correct, got {names}; correct each file", field="measurement")
    (observation,) = observations
    corrections = consistency.corrections.get(observation.technique.name, ())
    if not corrections:
        raise InputError("nothing was found in it that can be corrected", field="measurement")
    alone = observation.alone(measurement)
    if alone.names != measurement.names:
        raise InputError("expected valid pixels in every view; corrections number the views", field="measurement")
    for correction in corrections:
        alone = _corrected(correction, alone)
    return alone


def _corrected(correction: Correction, measurement: Measurement) -> Measurement:
    (observation,) = measurement.observations
    cameras, name, values = measurement.cameras, observation.technique.name, observation.values
    sigma = None if observation.sigma is None else correction.undo(observation.sigma, cameras).abs()

    def mask(valid: Tensor | None) -> Tensor | None:
        """The corrected mask, by way of a map with the channels of the values."""
        if valid is None:
            return None
        channels = valid.to(values.dtype)[..., None].expand(*valid.shape, values.shape[-1]).contiguous()
        return correction.undo(channels, cameras).abs()[..., 0] > 0.5

    result = measurement.observed({name: correction.undo(values, cameras)}, {name: sigma})
    # not the pixels hidden by bodies, which follow from the cameras
    return replace(result, valid=mask(measurement.valid), flow_mask=mask(measurement.flow_mask))
