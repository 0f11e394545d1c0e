"""Numbers of images in the names of files, by which the images of several cameras are paired.

A camera that drops a frame leaves a gap in these numbers, and the images after it keep theirs.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Int

from nerif.common.conventions import InputError

__all__ = ["Count", "common_count", "natural_order", "numbers_in_names", "words_of_names"]

Numbers = Int[np.ndarray, "frame"]

SIGNS = ("-", "+")
SPARSE = 10  # numbers per image, at most, of a count in which fewer than half of the steps are the smallest
FEW = 8  # ranges that are written out


def words_of_names(names: Sequence[str]) -> list[list[int | str]]:
    """Split names into numbers, and the text between them in small letters.

    A hyphen or plus is a sign where it follows no letter or digit (run_-3), and where other names have the same text
    without it, or the other sign (img-1 beside img2).
    """
    split = [re.findall(r"\d+|\D+", name) for name in names]
    texts = {word for words in split for word in words}
    result = []
    for words in split:
        signed: list[int | str] = []
        for k, word in enumerate(words):
            if not word.isdecimal():
                signed.append(word.lower())
                continue
            before = words[k - 1] if k else ""
            text, sign = before[:-1], before[-1:]
            free = not text[-1].isalnum() if text else k == 1
            others = {text, *(text + other for other in SIGNS if other != sign)}
            is_signed = sign in SIGNS and (free or bool(others & texts))
            if is_signed:
                signed[-1:] = [text.lower()] if text else []
            signed.append(-int(word) if is_signed and sign == "-" else int(word))
        result.append(signed)
    return result


def natural_order(names: Sequence[str]) -> list[int]:
    """Return the order of names in which img2 is before img10, and run_-3 before run_-2 and run_0."""
    keys = [[(0, w, "") if isinstance(w, int) else (1, 0, w) for w in words] for words in words_of_names(names)]
    return sorted(range(len(names)), key=lambda k: (keys[k], names[k]))


def numbers_in_names(names: Sequence[str]) -> Numbers | None:
    """Return the numbers that count files, increasing; None if their names have none.

    It is the number that differs in all names; of several, the one of least range, as times advance by more.
    """
    split = words_of_names(names)
    texts = [[w for w in words if isinstance(w, str)] for words in split]
    if len({len(words) for words in split}) > 1 or any(other != texts[0] for other in texts):
        return None
    columns = np.array([[w for w in words if isinstance(w, int)] for words in split], dtype=np.int64).T
    counts = [column for column in columns if (np.diff(column) > 0).all()]
    return min(counts, key=lambda column: column[-1] - column[0], default=None)


@dataclass(frozen=True)
class Count:
    """The common count of the flow images of several views: (number - first) // step - offset is the instant."""

    first: int = 0  #: number of instant 0
    step: int = 1  #: of the numbers
    offsets: Mapping[str, int] = field(default_factory=dict)  #: in instants, by the name of the view
    in_order: bool = False  #: whether the numbers are the places
    lines: tuple[str, ...] = ()  #: to report

    def instants(self, view: str, numbers: Numbers) -> Numbers:
        """Return the instants of the images of a view."""
        numbers = np.arange(len(numbers)) if self.in_order else numbers
        return (numbers - self.first) // self.step - self.offsets.get(view, 0)


def common_count(
    numbers: Mapping[str, Numbers], frame_offsets: Mapping[str, int | None], in_order: bool = False
) -> Count:
    """Pair the images of several views by their numbers.

    Cameras whose numbers have none in common are paired from their first images if they cover as many numbers, and so
    are a camera that counts from 0 and one that counts from 1.

    Parameters
    ----------
    numbers : of the flow images, increasing, by the name of the view
    frame_offsets : of each view in instants; None where it is not stated
    in_order : whether some are the places in the order of names, as the names have no numbers
    """
    lines = []
    if not in_order and not _is_count(numbers):
        in_order, steps = True, np.concatenate([np.diff(n) for n in numbers.values()])
        lines.append(f"the numbers of flow images advance by {steps.min()} to {steps.max()}: they do not count them")
    if in_order:
        numbers = {name: np.arange(len(n)) for name, n in numbers.items()}
        if len({len(n) for name, n in numbers.items() if frame_offsets[name] is None}) > 1:
            raise InputError(
                "no number in their names pairs them, and their counts differ: "
                + ", ".join(f"{name} {len(n)}" for name, n in numbers.items())
                + '; number the files by instants, or select some in views.toml: flow = "cam1/flow[0:9]"',
                field="flow images",
            )
        if len(numbers) > 1:
            lines.append("flow images are paired in the order of their names, which have no numbers in common")
    step = int(np.gcd.reduce([np.gcd.reduce(np.diff(n)) for n in numbers.values()])) or 1
    free = sorted((name for name in numbers if frame_offsets[name] is None), key=lambda name: int(numbers[name][0]))
    first = min(int(numbers[name][0]) for name in free or numbers)
    spans = {name: (int((n[0] - first) // step), int((n[-1] - first) // step)) for name, n in numbers.items()}
    offsets = {name: offset or 0 for name, offset in frame_offsets.items()} | _from_first(numbers, free, spans)
    stated = ", ".join(f"{name} {n[0]} to {n[-1]}" for name, n in numbers.items())
    if shifted := [name for name in free if offsets[name]]:
        options = " ".join(f"--frame-offset {name} {offsets[name]}" for name in shifted)
        lines.append(
            f"numbers of flow images differ ({stated}); paired from the first ones, as by {options}; if the same "
            "number is the same instant, give the offset 0"
        )
    elif len({spans[name] for name in free}) > 1:
        lines.append(f"flow images of the same number are one instant: {stated}")
    count = Count(first, step, offsets, in_order)
    instants = {name: count.instants(name, n) for name, n in numbers.items()}
    every = np.unique(np.concatenate([*instants.values()]))
    for name, present in instants.items():
        missing = every[(every > present[0]) & (every < present[-1]) & ~np.isin(every, present)]
        if len(missing):
            of_names = (missing - present[0]) * step + numbers[name][0]
            lines.append(f"view '{name}' has no flow image {_in_words(of_names, step)}; did its camera drop it?")
    gaps = np.setdiff1d(np.arange(every[0], every[-1]), every)
    if len(gaps):
        lines.append(f"no view has flow image {_in_words(gaps * step + first, step)}: a gap in time")
    return Count(first, step, offsets, in_order, tuple(lines))


def _is_count(numbers: Mapping[str, Numbers]) -> bool:
    """Whether numbers count images, with gaps; the steps of times are larger and uneven."""
    union = np.diff(np.unique(np.concatenate([*numbers.values()])))
    every = [np.diff(n) for n in numbers.values()]
    unit = np.gcd.reduce([np.gcd.reduce(steps) for steps in every])
    dense = union.sum() <= SPARSE * unit * len(union)
    return bool(dense or any(2 * (steps == unit).sum() >= len(steps) > 0 for steps in every))


def _from_first(
    numbers: Mapping[str, Numbers], free: Sequence[str], spans: Mapping[str, tuple[int, int]]
) -> dict[str, int]:
    """Offsets of views that are paired from their first images."""
    groups: list[list[str]] = []
    for name in free:
        last = max(spans[other][1] for other in groups[-1]) if groups else -1
        if spans[name][0] > last:
            groups.append([])
        groups[-1].append(name)
    starts = [min(spans[name][0] for name in group) for group in groups]
    lengths = {max(spans[name][1] for name in group) - start for group, start in zip(groups, starts, strict=True)}
    if len(lengths) > 1:
        raise InputError(
            "their numbers have none in common, and they do not cover as many: "
            + ", ".join(f"{name} {numbers[name][0]} to {numbers[name][-1]}" for name in free)
            + "; give --frame-offset VIEW N: number i is flow image i + N of that view",
            field="flow images",
        )
    offsets = {name: start for group, start in zip(groups, starts, strict=True) for name in group if start}
    zero, one = ([name for name in free if numbers[name][0] == spans[name][0] == k] for k in (0, 1))
    if zero and one:
        from_zero, from_one = (np.unique(np.concatenate([numbers[name] for name in some])) for some in (zero, one))
        if len(np.intersect1d(from_zero, from_one - 1)) > len(np.intersect1d(from_zero, from_one)):
            offsets |= dict.fromkeys(one, 1)
    return offsets


def _in_words(numbers: Numbers, step: int) -> str:
    """Numbers as ranges, such as 3, 5 to 9."""
    ranges: list[list[int]] = []
    for n in map(int, numbers):
        if ranges and n == ranges[-1][1] + step:
            ranges[-1][1] = n
        else:
            ranges.append([n, n])
    words = [f"{a}" if a == b else f"{a} to {b}" for a, b in ranges[:FEW]]
    return ", ".join(words) + (f" and {len(ranges) - FEW} more" if len(ranges) > FEW else "")
