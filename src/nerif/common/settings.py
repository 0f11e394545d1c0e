"""Choices and limits of settings: stated in the annotations of a dataclass, checked here.

norm: Literal["l2", "squared"] = "squared"
method: Literal[*METHODS] = "nerif"
voxels: Annotated[int, Ge(1)] = 64

Choices that are the keys of a registry are read from it whenever they are needed, since annotations are texts.
"""

from __future__ import annotations

import dataclasses
import math
import operator
import types
import typing
from collections.abc import Callable
from numbers import Real
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Lt

from nerif.common.conventions import InputError

__all__ = ["Count", "Length", "NonNegative", "Positive", "check_settings"]

Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]
Count = Annotated[int, Ge(1)]
Length = Annotated[float, Gt(0), Lt(math.inf)]

LIMITS: dict[type, tuple[Callable[[Any, Any], bool], str]] = {
    Gt: (operator.gt, "a number above {}"),
    Ge: (operator.ge, "{} or more"),
    Lt: (operator.lt, "a number below {}"),
    Le: (operator.le, "{} or less"),
}


def check_settings(settings: Any) -> None:
    """Check every field of a dataclass against the choices and limits of its annotation.

    Types are not checked: the command line, settings files and the type checker do that.
    """
    hints = typing.get_type_hints(type(settings), include_extras=True)
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if expected := _violated(value, hints[field.name]):
            raise InputError(f"expected {expected}, got {value!r}", field=field.name)


def _violated(value: Any, hint: Any) -> str:
    """Return what a hint expects of a value that violates it; empty if the value is valid."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return "" if value in parts else ("one of " if len(parts) > 1 else "") + ", ".join(map(str, parts))
    if origin in (typing.Union, types.UnionType):
        expected = [_violated(value, part) for part in parts]
        return "" if "" in expected else " or ".join(text for text in expected if text != "none")
    if hint is types.NoneType:
        return "" if value is None else "none"
    if origin is tuple:
        return _violated_item(value, parts)
    if origin is Annotated:
        return _violated_limits(value, hint.__metadata__)
    return ""


def _violated_item(values: Any, hints: tuple[Any, ...]) -> str:
    if not isinstance(values, tuple | list):
        return "a tuple of values"
    if hints[-1] is Ellipsis:
        hints = hints[:1] * len(values)
    if len(values) != len(hints):
        return f"{len(hints)} values"
    return next(filter(None, map(_violated, values, hints)), "")


def _violated_limits(value: Any, limits: tuple[Any, ...]) -> str:
    valid, texts = isinstance(value, Real), []
    for limit in limits:
        if type(limit) in LIMITS:
            within, text = LIMITS[type(limit)]
            bound = dataclasses.astuple(limit)[0]
            short = {Gt(0): "a positive number", Lt(math.inf): "finite"}
            texts.append(short.get(limit) or text.format(bound))
            valid = valid and within(value, bound)
    return "" if valid or not texts else " and ".join(texts)
