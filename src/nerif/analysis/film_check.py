"""Consistency of the views of a film (`nerif check m.zarr`): do all views show the same instants?

Each view is predicted by the others (`predicted_by_others`) at some consecutive instants, and compared with its film k
frames later. Both are expanded in cosines of time, row and column. In each band of frequencies, an octave of each, with
n coefficients and the correlation c of prediction and measurement, the evidence for k is

    -n/2 ln(1 - c^2) - 1/2 ln n,

the log-likelihood ratio of related against unrelated Gaussian variables, less the cost of a parameter (BIC), and 0 at
least. The evidence of a view is the sum over the bands; what does not change with time is excluded. So the bands that
the other views predict well decide; a correlation over all pixels would be that of details that few views do not
predict, and it hardly varies with k. The view with the largest gain of evidence is shifted, and all views are predicted
again, until none gains.

With these shifts the views are then compared at one instant (`check_consistency`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.analysis.consistency import (
    MAX_PIXELS,
    Consistency,
    binned,
    check_consistency,
    predicted_by_others,
    without_spikes,
)
from nerif.common.conventions import InputError
from nerif.common.findings import Finding
from nerif.common.installation import quoted, word_of
from nerif.common.times import whole_steps
from nerif.data.measurement import Measurement
from nerif.data.measurement_data import MASKS, integrals_of
from nerif.reconstruction.aperture import apply_aperture
from nerif.reconstruction.device import on_free_cores

__all__ = ["Evidence", "Excerpt", "Shift", "band_evidence", "check_film", "frame_shifts", "late_views"]

INSTANTS, MIN_INSTANTS = 8, 3  # that are predicted
REACH, MAX_REACH = 5, 40  # frames, of the shifts that are tried: at first, and where none of these stands out
CANDIDATES = 10  # places of the film of which the one with the largest change is used
VOXELS = 16  # of the predictions, along the longest edge: the bands that other views predict are coarse
MIN_GAIN = 25.0  # of evidence, for a shift; noise gains 18 at most
MIN_GAIN_AFTER = 5.0  # of a shift after the first one
MAX_ROUNDS, MAX_TRIALS = 12, 3  # shifts of one view; views that are tried
MIN_SHARE = 0.4  # of the gain of a view that is tried in the largest one
OCTAVES = (1, 2, 4, 8, 16, 32)  # first frequencies of the bands but the lowest, in half periods
MIN_COUNT, MAX_CORRELATION = 8, 0.999  # of a band


@runtime_checkable
class FrameSource(Protocol):
    """What the check needs of a film, such as a MeasurementSequence."""

    @property
    def times(self) -> Sequence[float]: ...
    def __len__(self) -> int: ...
    def frame(self, index: int) -> Measurement: ...
    def fullest(self) -> Measurement: ...


class Excerpt:
    """Some instants of a film, binned, by one technique and the views of its fullest instant; read when needed.

    Instants count the frames by their times: those that no camera recorded have no frame.

    Parameters
    ----------
    film : of which the frames are read
    aperture : depth of field, as in NeRIF
    """

    def __init__(self, film: FrameSource, aperture: str = "auto") -> None:
        self.film, self.aperture = film, aperture
        self.names = self.measurement(film.fullest()).names
        self._frames: dict[int, Measurement | None] = {}
        steps = whole_steps(np.asarray(film.times))
        self.places = {int(i): k for k, i in enumerate(range(len(film)) if steps is None else steps)}
        self.length = max(self.places, default=-1) + 1

    def measurement(self, frame: Measurement) -> Measurement:
        """Return the first technique of a frame."""
        return integrals_of(frame)[0].alone(apply_aperture(frame, self.aperture))

    def frame(self, instant: int) -> Measurement | None:
        """Return a binned frame, None if it lacks a view or is not in the film."""
        if instant not in self._frames:
            self._frames[instant] = self._read(self.places[instant]) if instant in self.places else None
        return self._frames[instant]

    def _read(self, place: int) -> Measurement | None:
        try:
            frame = self.measurement(self.film.frame(place))
            return without_spikes(binned(frame.select(self.names), MAX_PIXELS)) if frame.cameras else None
        except InputError:  # not written, or a view has no valid pixel
            return None

    def has(self, instants: Sequence[int]) -> bool:
        """Return whether all these instants have all views."""
        return all(self.frame(t) is not None for t in instants)

    def values(self, instants: Sequence[int]) -> Float[Tensor, "instant view row column c"]:
        """Return the maps of instants that have all views."""
        return torch.stack([frame.observations[0].values for t in instants if (frame := self.frame(t)) is not None])

    def shifted(self, instant: int, shifts: Sequence[int]) -> Measurement:
        """Return the binned measurement with each view from its frame instant + shift."""
        frame = self.frame(instant)
        assert frame is not None
        maps = torch.stack([self.values([instant + shift])[0, i] for i, shift in enumerate(shifts)])
        return frame.observed({frame.observations[0].technique.name: maps})

    def liveliest(self) -> range:
        """Return consecutive instants with all views, between which the flow changes most; empty if there are none."""
        count = min(INSTANTS, max(self.length - 2 * REACH, self.length // 2))
        if count < MIN_INSTANTS:
            return range(0)
        last = self.length - count
        margin = min(REACH, last // 2)
        starts = np.unique(np.linspace(margin, last - margin, CANDIDATES).round().astype(int)).tolist()
        changes = {start: self._change(start + count // 2) for start in starts}
        for start in sorted(starts, key=lambda start: -changes[start]):
            if self.has(range(start, start + count)):
                return range(start, start + count)
        return range(0)

    def _change(self, instant: int) -> float:
        """The rms change of the maps to the next instant, -1 if one of them lacks a view."""
        if not self.has([instant, instant + 1]):
            return -1.0
        a, b = self.values([instant, instant + 1])
        return float((b - a).square().nanmean().sqrt().nan_to_num())


# -- evidence -----------------------------------------------------------------------------------------------------


def band_evidence(
    predicted: Float[np.ndarray, "instant row column c"], measured: Float[np.ndarray, "instant row column c"]
) -> float:
    """Return the evidence that the changes of two films are related."""
    from scipy.fft import dctn

    a, b = (dctn(film, axes=(0, 1, 2), norm="ortho")[1:] for film in (predicted, measured))  # without the mean of time
    time, rows, columns, channels = (np.arange(n) for n in a.shape)
    octaves = (np.searchsorted(OCTAVES, x, "right") for x in (time + 1, rows, columns))
    parts = (*3 * (len(OCTAVES) + 1,), len(channels))
    label = np.ravel_multi_index(np.ix_(*octaves, channels), parts).ravel()
    count, product, square_a, square_b = (
        np.bincount(label, weights) for weights in (None, (a * b).ravel(), (a * a).ravel(), (b * b).ravel())
    )
    size = np.sqrt(square_a * square_b)
    correlation = np.divide(product, size, out=np.zeros_like(product), where=size > 0).clip(0, MAX_CORRELATION)
    ratio = -0.5 * (count * np.log1p(-(correlation**2)) + np.log(count.clip(1)))
    return float(ratio[count >= MIN_COUNT].clip(0).sum())


@dataclass(frozen=True)
class Evidence:
    """Evidence of one view for each shift of its film."""

    by_shift: Mapping[int, float]  #: in frames; 0 is in it

    @property
    def best(self) -> int:
        """Shift with the largest evidence."""
        return max(self.by_shift, key=lambda k: self.by_shift[k])

    @property
    def gain(self) -> float:
        """How much larger the largest evidence is than that for no shift."""
        return self.by_shift[self.best] - self.by_shift[0]

    @property
    def stands_out(self) -> bool:
        """Whether one shift has clearly more evidence than all others."""
        first, second = sorted((*self.by_shift.values(), 0.0), reverse=True)[:2]
        return first - second > MIN_GAIN

    @property
    def sharp(self) -> bool:
        """Whether the evidence for no shift clearly exceeds that for any other."""
        others = [value for k, value in self.by_shift.items() if k]
        return bool(others) and self.by_shift[0] - max(others) > MIN_GAIN


def _evidences(
    excerpt: Excerpt, instants: range, shifts: Sequence[int], voxels: int, on_step: Callable[[int, int], None]
) -> list[Evidence]:
    """The evidence of every view for shifts beyond the given ones."""
    views = range(len(excerpt.names))
    predictions: dict[int, list[Tensor]] = {i: [] for i in views}
    for t in instants:
        small = excerpt.shifted(t, shifts)
        for i in views:
            predictions[i].append(predicted_by_others(small, [i], voxels)[i])
            on_step(sum(map(len, predictions.values())), len(views) * len(instants))
    films = [torch.stack(predictions[i]).numpy() for i in views]
    results = [Evidence(_of_shifts(excerpt, instants, i, shifts[i], films[i], range(-REACH, REACH + 1))) for i in views]
    for i in views:
        reach = REACH
        while reach < MAX_REACH and (abs(results[i].best) == reach or not results[i].stands_out):
            further = [k for k in range(-2 * reach, 2 * reach + 1) if abs(k) > reach]
            more = _of_shifts(excerpt, instants, i, shifts[i], films[i], further)
            results[i], reach = Evidence({**results[i].by_shift, **more}), 2 * reach
    return results


def _of_shifts(
    excerpt: Excerpt, instants: range, view: int, start: int, predicted: np.ndarray, further: Sequence[int]
) -> dict[int, float]:
    """The evidence of one view for those of the further shifts whose frames exist."""
    rows, columns = predicted.shape[1:3]
    evidence = {}
    for k in further:
        frames = [t + start + k for t in instants]
        if excerpt.has(frames):
            measured = excerpt.values(frames)[:, view, :rows, :columns].numpy()
            good = np.isfinite(measured).all(axis=(0, 3))[..., None]
            evidence[k] = band_evidence(np.where(good, predicted, 0), np.where(good, measured, 0))
    return evidence


# -- shifts of the films ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shift:
    """The shift of a view's film: its frame i + frames shows what most others show in frame i."""

    name: str  #: of the view
    frames: int  #: positive if the film is late
    gain: float  #: of evidence, over no shift
    sharp: bool  #: whether every other shift would fit clearly worse
    at_end: bool = False  #: whether the film is too short for a larger shift

    @property
    def clear(self) -> bool:
        """Whether the film is clearly late or early."""
        return self.frames != 0 and self.gain > MIN_GAIN


def frame_shifts(
    excerpt: Excerpt, instants: range, voxels: int = VOXELS,
    on_step: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Shift, ...]:  # fmt: skip
    """Shift the film of one view after the other, while its evidence and that of all views together gain.

    A late film also moves the best shifts of its neighbours, so the views with the largest gains are tried.

    Parameters
    ----------
    instants : consecutive ones with all views, at which each view is predicted by the others
    voxels : of the predictions, along the longest edge
    on_step : called with the numbers of finished and of all predictions of this round
    """
    count = len(excerpt.names)
    shifts = [0] * count
    evidences = _evidences(excerpt, instants, shifts, voxels, on_step)
    for _ in range(MAX_ROUNDS):
        gains = [evidence.gain for evidence in evidences]
        if max(gains) < (MIN_GAIN_AFTER if any(shifts) else MIN_GAIN):
            break
        trials, likely = [], [i for i in range(count) if gains[i] >= MIN_SHARE * max(gains)]
        for view in sorted(likely, key=lambda i: -gains[i])[:MAX_TRIALS]:
            trial = [shift + (i == view) * evidences[view].best for i, shift in enumerate(shifts)]
            trials.append((trial, _evidences(excerpt, instants, trial, voxels, on_step)))
        best = max(trials, key=lambda trial: _total(trial[1]))
        if _total(best[1]) <= _total(evidences):
            break
        shifts, evidences = best
    (usual, _), *_ = Counter(shifts).most_common(1)  # most films are synchronous
    return tuple(
        Shift(
            name,
            frames := shift - usual,
            e.by_shift[0] - e.by_shift.get(-frames, 0.0),
            e.sharp,
            (1 if frames > 0 else -1) not in e.by_shift,
        )
        for name, shift, e in zip(excerpt.names, shifts, evidences, strict=True)
    )


def _total(evidences: Sequence[Evidence]) -> float:
    """The evidence of all views without further shifts."""
    return sum(evidence.by_shift[0] for evidence in evidences)


def late_views(shifts: Sequence[Shift], frame_offsets: Mapping[str, int]) -> list[Finding]:
    """Return a finding for each group of views that is clearly late or early by the same number of frames.

    Parameters
    ----------
    shifts : of all views
    frame_offsets : of the films, by the names of views, with which the measurement was made
    """
    frames = {shift.name: shift.frames if shift.clear else 0 for shift in shifts}
    sizes = [size for _, size in Counter(frames.values()).most_common()]
    undecided = len(sizes) > 1 and sizes[0] == sizes[1]
    findings = []
    for late in sorted({k for k in frames.values() if k}):
        views = tuple(name for name, k in frames.items() if k == late)
        films = f"{'its film is' if len(views) == 1 else 'their films are'} {_words(late)}"
        if undecided:
            films += f", or the other views {_words(-late)}; equal numbers of views do not decide"
        if any(shift.at_end for shift in shifts if shift.name in views):
            films += ", or more, as the film is too short for larger offsets: measure more frames to be sure"
        gains = ", ".join(f"{shift.gain:.0f}" for shift in shifts if shift.name in views)
        offsets = {quoted(word_of(name)): frame_offsets.get(name, 0) + late for name in views}
        options = " ".join(f"--frame-offset {name} {frames}" for name, frames in offsets.items())
        subject = Finding.subject(views, len(shifts))
        sentence = f"{subject}: {films} (gain of evidence {gains}; {MIN_GAIN:g} is clear): nerif displacement {options}"
        findings.append(Finding("late", sentence, views))
    return findings


def _words(late: int) -> str:
    return f"{abs(late)} frame{'s' if abs(late) > 1 else ''} {'late' if late > 0 else 'early'}"


# -- the check ----------------------------------------------------------------------------------------------------


@on_free_cores
def check_film(
    film: FrameSource, voxels: int = 24, on_step: Callable[[int, int], None] = lambda done, total: None,
    aperture: str = "auto",
) -> Consistency:  # fmt: skip
    """Find views whose films are late or early, and compare the views of one instant with each other.

    Parameters
    ----------
    film : measurements over time, of two views or more
    voxels : of the reconstructions of one instant, as in check_consistency
    on_step : called with the numbers of finished and of all reconstructions of this round
    aperture : depth of field, as in NeRIF
    """
    excerpt = Excerpt(film, aperture)
    instants, remarks = excerpt.liveliest(), []
    findings: list[Finding] = []
    measurement = film.fullest()
    if len(excerpt.names) < 2:
        remarks.append("one view: its film cannot be compared with others")
    elif not instants:
        remarks.append("too few consecutive instants with all views: frame offsets were not examined")
    else:
        shifts = frame_shifts(excerpt, instants, min(voxels, VOXELS), on_step)
        findings = late_views(shifts, measurement.frame_offsets)
        if vague := [shift.name for shift in shifts if not (shift.sharp or shift.clear)]:
            remarks.append(
                f"{Finding.subject(vague, len(shifts))}: the frame offset is not certain to one frame, as the flow "
                "changes too little from frame to frame, or the other views predict it poorly"
            )
        elif not findings:
            remarks.append("the films of all views are synchronous")
        late = {shift.name: shift.frames for shift in shifts if shift.clear}
        instant = next((t for t in instants if excerpt.has([t + k for k in late.values()])), None)
        if instant is None:
            instant, late = instants[0], {}
        measurement = _synchronous(excerpt, instant, late)
        remarks.append(f"the views were compared at instant {instant}")
    result = check_consistency(measurement, voxels, on_step, aperture)
    return replace(result, findings=(*findings, *result.findings), remarks=(*remarks, *result.remarks))


def _synchronous(excerpt: Excerpt, instant: int, shifts: Mapping[str, int]) -> Measurement:
    """The measurement of one instant, with some views from frames that many later."""
    result = excerpt.film.frame(excerpt.places[instant])
    for name, shift in shifts.items():
        later = excerpt.film.frame(excerpt.places[instant + shift])
        i, j = result.names.index(name), later.names.index(name)

        def exchanged(ours: Tensor | None, theirs: Tensor | None, i: int = i, j: int = j) -> Tensor | None:
            if ours is None or theirs is None:
                return None
            return torch.cat([ours[:i], theirs[j : j + 1], ours[i + 1 :]])

        fields = ("displacement", "sigma", *MASKS)
        changes: dict[str, Any] = {field: exchanged(getattr(result, field), getattr(later, field)) for field in fields}
        maps: Any = {key: exchanged(value, later.maps[key]) for key, value in result.maps.items()}
        result = replace(result, maps=maps, **changes)
    return result
