"""A claim of the paper: as a question to the records, and judged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from study.results import Results

__all__ = ["Claim", "Question", "Verdict"]

Verdict = Literal["reproduced", "not reproduced", "not tested"]


@dataclass(frozen=True)
class Claim:
    """A claim with what the paper has for it, what came out here, and the verdict.

    Parameters
    ----------
    text : the claim, and what its vague words are taken for
    paper, here : numbers, or why there are none
    verdict : reproduced, not reproduced or not tested
    """

    text: str
    paper: str
    here: str
    verdict: Verdict


@dataclass(frozen=True)
class Question:
    """A claim to be judged.

    Parameters
    ----------
    text, paper : see Claim
    answer : what the records have for it, and whether that bears it out; None where they cannot tell
    """

    text: str
    paper: str
    answer: Callable[[Results], tuple[str, bool | None]]
