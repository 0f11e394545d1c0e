"""Reference images that differ from the others: black, over-exposed, another scene, a moved camera, flow.

References repeat one scene, so each is compared with the median of all that show the same scene. Every limit is
relative to the scatter of the others, since the camera may vibrate and the air of the room move.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from nerif.common.conventions import percent
from nerif.imaging.noise import local_correlation
from nerif.imaging.quality.thumbnails import TILE, Thumbnail, local_displacement, match, shifted, thumbnails
from nerif.imaging.readers.exposure import saturated
from nerif.imaging.readers.views import View, ViewFrames

__all__ = ["Outliers", "flow_thumbnail", "outliers", "without_outliers"]

CANDIDATES = 9  # images of which one stands for the scene
SAME_SCENE = 0.5  # least correlation, relative to the highest one of the scene
REPEATS = 0.3  # least correlation of two images of a scene; below, noise hides the pattern and nothing is compared
BLACK = 0.3  # of the mean grey of the others
OVEREXPOSED = 0.02, 5.0  # least share of the pixels, and least ratio to the share of the others
STILL = 0.3  # px, a shift below this is no outlier,
MOVED = 3.0  # px, one above this is, if it exceeds
SCATTERS = 6.0  # standard deviations of the shifts (more for few images)
LOCAL = 0.3, 4.0  # px, least local displacement of flow, and least ratio to that of the other images
SHARE = 0.05  # of the image with such a displacement
UNCORRELATED = 0.2  # local correlation of an object with the pattern behind it, at most
FOREIGN = 0.05, 4.0  # least share of the image without correlation, and least ratio to that of the others
BLURRED = 1.0  # px, scatter of the shifts from which their mean is blurred


@dataclass(frozen=True)
class Outliers:
    """Reference images that differ from the others."""

    reasons: Mapping[int, str]  #: by the number of the image
    note: str = ""  #: what cannot be decided, or ""


def outliers(
    references: Sequence[Thumbnail], overexposed: Sequence[float], flow: Callable[[], Thumbnail | None]
) -> Outliers:
    """Return the reference images that differ from the others.

    Parameters
    ----------
    overexposed : share of over-exposed pixels of each image
    flow : returns an image with flow; called where references contradict one another
    """
    reasons = _overexposed(overexposed)
    rest = [i for i in range(len(references)) if i not in reasons]
    if len(rest) < 2:
        return Outliers(reasons)
    scene, note = _scene([references[i] for i in rest], flow)
    if note:
        return Outliers(reasons, note)
    same = [rest[k] for k in scene]
    level = float(np.median([references[i].grey for i in same]))
    for i in rest:
        if i not in same:
            grey = references[i].grey
            black = f"nearly black, with a mean grey value of {grey:.0f} beside {level:.0f} of the others"
            other = "does not correlate with the other references; another scene?"
            reasons[i] = black if grey < BLACK * level else other
    if len(same) == 2:
        reason, note = _moved_pair([references[i] for i in same], flow)
        return Outliers(reasons | {same[k]: text for k, text in reason.items()}, note)
    if len(same) > 2:
        reason, note = _moved([references[i] for i in same])
        reasons |= {same[k]: text for k, text in reason.items()}
    return Outliers(reasons, note)


def without_outliers(view: View, images: ViewFrames, say: Callable[[str], None]) -> ViewFrames:
    """Return the reference images of a view that agree with one another; report the others."""
    full = view.full_scale
    small, shares = [], []
    for image in images:  # read once
        small.append(Thumbnail.of(image))
        shares.append(float(np.mean(saturated(image, full))))
    result = outliers(small, shares, lambda: flow_thumbnail(view, images[0].shape))
    for i, reason in sorted(result.reasons.items()):
        say(f"left out: {images.name(i)}: {reason}")
    if result.note:
        say(f"note: view '{view.name}': {result.note}")
    return images.select([i for i in range(len(images)) if i not in result.reasons])


def flow_thumbnail(view: View, shape: tuple[int, ...]) -> Thumbnail | None:
    """Return an image with flow of this shape; None if a few have none."""
    return next(thumbnails(view, "flow", 3, shape), None)


def _overexposed(shares: Sequence[float]) -> dict[int, str]:
    least, ratio = OVEREXPOSED
    reasons = {}
    for i, share in enumerate(shares):
        others = float(np.median([*shares[:i], *shares[i + 1 :]])) if len(shares) > 1 else share
        if share > max(least, ratio * others):
            reasons[i] = f"{percent(share)} of the pixels are over-exposed, {percent(others)} in the other references"
    return reasons


def _scene(references: Sequence[Thumbnail], flow: Callable[[], Thumbnail | None]) -> tuple[list[int], str]:
    """Numbers of the images that show the scene of most, by the flow image if there is no majority; or why none do."""
    count = len(references)
    candidates = dict.fromkeys(np.linspace(0, count - 1, min(count, CANDIDATES)).round().astype(int).tolist())
    for k in candidates:
        correlation = [match(references[k], other)[0] if i != k else 0.0 for i, other in enumerate(references)]
        least = max(REPEATS, SAME_SCENE * max(correlation))
        same = [i for i, c in enumerate(correlation) if i == k or c >= least]
        if 2 * len(same) > count:
            return same, ""
    image = flow()
    likeness = [0.0 if image is None else match(r, image)[0] for r in references]
    same = [i for i, c in enumerate(likeness) if c >= max(REPEATS, SAME_SCENE * max(likeness))]
    if same:
        return same, ""
    return [], (
        f"the {count} references do not correlate with one another, nor with the flow images; do they show one "
        "pattern, in focus and well exposed?"
    )


def _moved(references: Sequence[Thumbnail]) -> tuple[dict[int, str], str]:
    """Images that are shifted, or differ in a part, from the median of three or more; and a note if all scatter."""
    count, median = len(references), Thumbnail.median(references)
    shifts = np.array([match(median, r)[1] for r in references])
    shifts -= np.median(shifts, axis=0)
    distance = np.linalg.norm(shifts, axis=-1)
    scatter = float(np.median(distance)) / np.sqrt(2 * np.log(2))  # of a component: Rayleigh's distribution
    most = SCATTERS + 60 / (count - 2) ** 1.5  # one set in a thousand has such a shift by chance
    limit = max(STILL, min(most * scatter, max(MOVED, SCATTERS * scatter)))
    local, foreign = np.transpose([_local(median, r) for r in references])
    reasons = {}
    for i in range(count):
        for values, (least, ratio), difference in (
            (local, LOCAL, f"displaced by {local[i]:.1f} px or more in {SHARE:.0%} of the image"),
            (foreign, FOREIGN, f"without correlation in {foreign[i]:.0%} of the image"),
        ):
            if values[i] > max(least, ratio * float(np.median(np.delete(values, i)))):
                reasons[i] = f"differs locally from the other references, {difference}; flow, or an object in view?"
        if distance[i] > max(limit, local[i]):
            x, y = shifts[i]
            reasons[i] = f"shifted by ({x:.1f}, {y:.1f}) px from the other references; camera moved?"
    return reasons, _blurred(float(distance[distance <= limit].max())) if scatter > BLURRED else ""


def _local(median: Thumbnail, image: Thumbnail) -> tuple[float, float]:
    """Displacement (px) that is exceeded in a part of the image, and share of the image without correlation."""
    aligned = shifted(median, match(median, image)[1])
    size = np.linalg.norm(local_displacement(aligned, image.detail), axis=-1) * image.binning
    correlation = local_correlation(aligned, image.detail, TILE / 2)
    return float(np.quantile(size, 1 - SHARE)), float(np.mean(correlation < UNCORRELATED))


def _moved_pair(references: Sequence[Thumbnail], flow: Callable[[], Thumbnail | None]) -> tuple[dict[int, str], str]:
    """Which of two references is shifted, by the flow image; or a note that one of them is."""
    shift = match(*references)[1]
    if np.linalg.norm(shift) <= MOVED:
        return {}, ""
    image = flow()
    if image is not None:
        distance = [float(np.linalg.norm(match(r, image)[1])) for r in references]
        near, far = np.argsort(distance)
        if distance[near] < BLURRED < MOVED < distance[far]:
            text = f"shifted by {distance[far]:.1f} px from the other reference and the flow images; camera moved?"
            return {int(far): text}, ""
    return {}, _blurred(float(np.linalg.norm(shift)))


def _blurred(shift: float) -> str:
    return (
        f"references are shifted by up to {shift:.1f} px from one another, which blurs their mean; camera moved? "
        "Keep those that match the flow images"
    )
