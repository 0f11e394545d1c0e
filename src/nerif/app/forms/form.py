"""Forms from the settings records: fields, help texts, defaults, choices and the command line.

The record checks the values and names the invalid field.
"""

from __future__ import annotations

import dataclasses
import re
import types
import typing
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import tyro

from nerif.cli.commands.settings import flat_names, help_of, merge
from nerif.common.conventions import InputError
from nerif.common.installation import word_of

__all__ = ["Form", "FormField"]

T = TypeVar("T")

UNITS = ("mm", "px", "nm", "K", "Pa", "degrees", "s", "seconds", "mrad", "Hz", "GB")
HIDDEN = ("config",)
MISSING = (tyro.MISSING,)


@dataclass(frozen=True)
class FormField:
    """One setting.

    Parameters
    ----------
    name : name of the flag, with underscores; network.width for a field of the record `network`
    kind : switch, integer, number, choice, words (separated by spaces) or text
    help : documentation of the field in the record
    unit : unit of a number; empty if it has none
    default : default value
    choices : valid words; empty for free text
    optional : whether the value may be None
    """

    name: str
    kind: str
    help: str
    unit: str
    default: Any
    choices: tuple[str, ...] = ()
    optional: bool = False

    @property
    def label(self) -> str:
        """The label of its control."""
        return self.name.replace("_", " ").replace(".", ": ").capitalize()

    @property
    def flag(self) -> str:
        """The flag on the command line."""
        return "--" + self.name.replace("_", "-")

    def words(self, value: Any) -> list[str]:
        """Return the arguments that set the value on the command line."""
        if self.kind == "switch":
            group, dot, last = self.flag[2:].rpartition(".")
            return [self.flag if value else f"--{group}{dot}no-{last}"]
        values = value if isinstance(value, list | tuple) else [value]
        return [self.flag, *("None" if v is None else f"{v:g}" if _whole(v) else word_of(v) for v in values)]


class Form(Generic[T]):
    """The settings of a command, or some of them.

    Parameters
    ----------
    record : settings with the defaults; tyro.MISSING where there is none
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
        fields = {f.name: f for f in _fields(record)}
        if others := [name for name in only if name not in fields]:
            raise InputError(f"expected some of {', '.join(fields)}, got {', '.join(others)}", field="only")
        self.fields = tuple(fields[name] for name in only or fields if name not in without)

    def field(self, name: str) -> FormField:
        """Return a field by its name."""
        return next(f for f in self.fields if f.name == name)

    def changed(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of shown fields that differ from their defaults."""
        defaults = {f.name: f.default for f in self.fields}
        return {
            name: value for name, value in values.items() if name in defaults and not _same(value, defaults[name])
        }  # fmt: skip

    def build(self, values: Mapping[str, Any]) -> T:
        """Return the record with the values; InputError if one is invalid."""
        return merge(self.record, _nested(self.changed(values)), "here")

    def errors(self, values: Mapping[str, Any]) -> dict[str, str]:
        """Return the errors by field; an error of several fields together is under ""."""
        errors: dict[str, str] = {}
        changed = self.changed(values)
        for name, value in changed.items():
            try:
                merge(self.record, _nested({name: value}), "here")
            except InputError as error:
                errors[name] = _short(error, name)
        rest = {name: value for name, value in changed.items() if name not in errors}
        try:
            merge(self.record, _nested(rest), "here")
        except InputError as error:
            where = next((f.name for f in self.fields if f.name.rpartition(".")[2] == error.field), "")
            errors[where] = _short(error, where)
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
        words = [word for f in self.fields if f.name in changed for word in f.words(changed[f.name])]
        return [*self.verb, *words]


def _fields(record: Any, prefix: str = "") -> list[FormField]:
    """Return the fields of a record; those of nested records are in the place of the record."""
    cls, fields = type(record), []
    for name, where in flat_names(cls).items():
        holder = getattr(record, where[0]) if len(where) == 2 else record
        hint = typing.get_type_hints(type(holder), include_extras=True)[name]
        if typing.get_origin(hint) is typing.Annotated:
            if tyro.conf.Suppress in hint.__metadata__:
                continue
            hint = hint.__origin__
        value = getattr(holder, name)
        if dataclasses.is_dataclass(value):
            fields += _fields(value, f"{prefix}{name}.")
            continue
        default = None if value in MISSING else value
        text = help_of(type(holder), name)
        kind, words, optional = _kind(hint)
        numbers = kind in ("integer", "number") or (kind == "words" and "str" not in str(hint))
        unit = _unit(text) if numbers else ""
        fields.append(FormField(prefix + name, kind, text, unit, default, words, optional))
    return fields


def _kind(hint: Any) -> tuple[str, tuple[str, ...], bool]:
    """Return the kind of control for a type, its choices, and whether None is valid."""
    options = typing.get_args(hint) if typing.get_origin(hint) in (types.UnionType, typing.Union) else (hint,)
    optional = type(None) in options
    others = [o for o in options if o is not type(None)]
    hint = others[0].__origin__ if typing.get_origin(others[0]) is typing.Annotated else others[0]
    if typing.get_origin(hint) is Literal and len(others) == 1:
        return "choice", typing.get_args(hint), optional
    if typing.get_origin(hint) is tuple:
        return "words", (), optional
    kinds = {bool: "switch", int: "integer", float: "number", str: "text", Path: "text"}
    return kinds.get(hint, "text"), (), optional


def _unit(text: str) -> str:
    """Return the unit at the end of a clause of the help text."""
    for clause in re.split(r"[;.]\s|[.;]$", text):
        for part in re.split(r", | \(", clause):
            if (word := (part.strip(" ).").split() or [""])[-1]) in UNITS:
                return {"seconds": "s"}.get(word, word)
    return ""


def _whole(value: Any) -> bool:
    return isinstance(value, float) and float(f"{value:g}") == value


def _same(value: Any, default: Any) -> bool:
    if isinstance(value, list | tuple) and isinstance(default, list | tuple):
        return list(value) == list(default)
    return (type(value) is type(default) and value == default) or (
        isinstance(value, int | float) and isinstance(default, int | float)
        and not isinstance(value, bool) and not isinstance(default, bool) and value == default
    )  # fmt: skip


def _nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values in the layout of a settings file: network.width in the table `network`."""
    table: dict[str, Any] = {}
    for name, value in values.items():
        *groups, last = name.split(".")
        inner = table
        for group in groups:
            inner = inner.setdefault(group, {})
        inner[last] = list(value) if isinstance(value, tuple) else value
    return table


def _short(error: InputError, name: str) -> str:
    """Return the message for a place beside the field, without the field name."""
    message = re.sub(r"^here(?: \[\w+\])?: ", "", str(error))
    short = re.sub(rf"^'?{re.escape(name.rpartition('.')[2])}'?(?: = [^:]*)?: ", "", message)
    return short[:1].upper() + short[1:]
