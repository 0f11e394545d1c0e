"""Forms from the settings records: fields, help texts, defaults, choices and the command line.

The record checks the values and names the invalid field.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Generic, TypeVar

from nerif.common.conventions import InputError
from nerif.common.installation import word_of
from nerif.common.settings import MISSING, Developer, Option, merge, options

__all__ = ["Form", "default_of", "label_of", "unit_of"]

T = TypeVar("T")

UNITS = ("mm", "px", "nm", "K", "Pa", "degrees", "s", "seconds", "mrad", "Hz", "GB")
HIDDEN = ("config",)


class Form(Generic[T]):
    """The settings of a command, or some of them.

    Parameters
    ----------
    record : settings with the defaults; MISSING where there is none
    verb : first arguments of the command line
    only : names of the fields to show; empty: all
    without : names of the fields to hide
    """

    def __init__(
        self,
        record: T,
        verb: Sequence[str] = (),
        only: Sequence[str] = (),
        without: Collection[str] = HIDDEN,
    ) -> None:
        self.record, self.verb = record, tuple(verb)
        fields = {name: option for name, option in options(record).items() if Developer not in option.marks}
        if others := [name for name in only if name not in fields]:
            raise InputError(f"expected some of {', '.join(fields)}, got {', '.join(others)}", field="only")
        self.fields = tuple(fields[name] for name in only or fields if name not in without)

    def field(self, name: str) -> Option:
        """Return a field by its name."""
        return next(f for f in self.fields if f.name == name)

    def changed(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of shown fields that differ from their defaults."""
        defaults = {f.name: default_of(f) for f in self.fields}
        return {
            name: value for name, value in values.items() if name in defaults and not _same(value, defaults[name])
        }  # fmt: skip

    def build(self, values: Mapping[str, Any]) -> T:
        """Return the record with the values; InputError if one is invalid."""
        return merge(self.record, self.changed(values))

    def errors(self, values: Mapping[str, Any]) -> dict[str, str]:
        """Return the errors by field; an error of several fields together is under ""."""
        errors: dict[str, str] = {}
        changed = self.changed(values)
        for name, value in changed.items():
            try:
                merge(self.record, {name: value})
            except InputError as error:
                errors[name] = _short(error)
        try:
            merge(self.record, {name: value for name, value in changed.items() if name not in errors})
        except InputError as error:
            errors[next((f.name for f in self.fields if error.field in (f.name, f.place[-1])), "")] = _short(error)
        # a value may be valid only together with another one
        return {name: error for name, error in errors.items() if not name or not self._valid(values)}

    def _valid(self, values: Mapping[str, Any]) -> bool:
        try:
            self.build(values)
        except InputError:
            return False
        return True

    def arguments(self, values: Mapping[str, Any]) -> list[str]:
        """Return the arguments of nerif: the verb, and the flags of values other than the defaults."""
        changed = self.changed(values)
        words = [word for f in self.fields if f.name in changed for word in _words(f, changed[f.name])]
        return [*self.verb, *words]


def label_of(field: Option) -> str:
    """Return the label of the control of a field."""
    return field.name.replace("_", " ").replace(".", ": ").capitalize()


def default_of(field: Option) -> Any:
    """Return the default of a field, None if it is required."""
    return None if field.default is MISSING else field.default


def unit_of(field: Option) -> str:
    """Return the unit of a field of numbers, at the end of a clause of its help text; empty if it has none."""
    if "FLOAT" not in field.values and "INT" not in field.values:
        return ""
    for clause in re.split(r"[;.]\s|[.;]$", field.help):
        for part in re.split(r", | \(", clause):
            if (word := (part.strip(" ).").split() or [""])[-1]) in UNITS:
                return {"seconds": "s"}.get(word, word)
    return ""


def _words(field: Option, value: Any) -> list[str]:
    """Return the arguments that set the value of a field on the command line."""
    if field.kind == "switch":
        return [field.flag if value else field.off]
    values = value if isinstance(value, list | tuple) else [value]
    return [field.flag, *("None" if v is None else f"{v:g}" if _whole(v) else word_of(v) for v in values)]


def _whole(value: Any) -> bool:
    return isinstance(value, float) and float(f"{value:g}") == value


def _same(value: Any, default: Any) -> bool:
    if isinstance(value, list | tuple) and isinstance(default, list | tuple):
        return list(value) == list(default)
    return (type(value) is type(default) and value == default) or (
        isinstance(value, int | float) and isinstance(default, int | float)
        and not isinstance(value, bool) and not isinstance(default, bool) and value == default
    )  # fmt: skip


def _short(error: InputError) -> str:
    """Return the message for a place beside the field, without the field name."""
    short = str(error).removeprefix(f"{error.field}: ")
    return short[:1].upper() + short[1:]
