"""Choices and limits in annotations."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import pytest
from annotated_types import Ge, Le, Lt

from nerif.common.settings import Checked, Count, NonNegative, Positive
from refusals import refused

SHAPES = {"round": 1}


@dataclass(frozen=True)
class Example(Checked):
    norm: Literal["l2", "squared"] = "l2"
    weight: Literal["auto"] | Annotated[float, Ge(0), Lt(math.inf)] = "auto"
    sigma: Positive | None = None
    limit: NonNegative = 0.0
    dpi: Annotated[int, Ge(20), Le(2400)] = 300
    shape: tuple[Count, Count] = (1, 2)
    names: tuple[str, ...] = ()
    note: str = ""
    outline: Literal[*SHAPES] = "round"  # type: ignore[valid-type]


def test_valid_values():
    Example("squared", 0, 1e-3, 5, 20, (3, 1), ("a", "b"), "x")


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("norm", "l3", "one of l2, squared, got 'l3'"),
        ("weight", -1.0, "auto or 0 or more, got -1.0"),
        ("weight", math.inf, "finite"),
        ("weight", "much", "auto"),
        ("sigma", 0.0, "a positive number, got 0.0"),
        ("limit", math.nan, "0 or more, got nan"),
        ("dpi", 2401, "2400 or less"),
        ("shape", (1, 0), "1 or more"),
        ("shape", (1, 2, 3), "2 values"),
        ("names", "ab", "a list of values"),
    ],
)  # fmt: skip
def test_invalid_values(field, value, words):
    with refused(field) as error:
        replace(Example(), **{field: value})
    assert words in str(error.value)


def test_choices_of_a_registry_are_those_of_now(monkeypatch):
    with refused("outline"):
        Example(outline="square")
    monkeypatch.setitem(SHAPES, "square", 4)
    assert Example(outline="square").outline == "square"
