"""Forms made from the records of settings: their fields, texts, defaults, choices; and the command line that they give.

Nothing is checked here: values are put into the record, which refuses what cannot be right and names the field.
"""

from __future__ import annotations

import dataclasses
import re
import types
import typing
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import tyro

from nerif.cli.commands.settings import flat_names, help_of, merge
from nerif.common.conventions import InputError

__all__ = ["Form", "FormField"]

T = TypeVar("T")

UNITS = ("mm", "px", "nm", "K", "Pa", "degrees", "s", "seconds", "mrad", "Hz", "GB")
LEFT_OUT = ("config",)
MISSING = (tyro.MISSING,)


@dataclass(frozen=True)
class FormField:
    """One setting.

    Parameters
    ----------
    name : as flags have it, with underscores; network.width for a field of the record `network`
    kind : switch, integer, number, choice, words (several, with spaces between), or text
    help : what the record says of it
    unit : of a number; empty if it has none
    default : value if nothing is asked for
    choices : words to choose from; empty if any text may stand there
    optional : whether it may be left without a value
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
        """Its name for people."""
        return self.name.replace("_", " ").replace(".", ": ").capitalize()

    @property
    def flag(self) -> str:
        """Its name on the command line."""
        return "--" + self.name.replace("_", "-")

    def words(self, value: Any) -> list[str]:
        """Return what gives it that value on the command line."""
        if self.kind == "switch":
            group, dot, last = self.flag[2:].rpartition(".")
            return [self.flag if value else f"--{group}{dot}no-{last}"]
        values = value if isinstance(value, list | tuple) else [value]
        return [self.flag, *("None" if v is None else f"{v:g}" if _whole(v) else str(v) for v in values)]


class Form(Generic[T]):
    """The settings of a verb, or of a part of it.

    Parameters
    ----------
    record : with the defaults; tyro.MISSING where there is none
    verb : of the command line, with what always stands there
    only : names of the fields that are shown; all if empty
    without : names of fields that are not
    choices : of fields whose record does not tell them
    """

    def __init__(
        self,
        record: T,
        verb: Sequence[str] = (),
        only: Sequence[str] = (),
        without: Collection[str] = LEFT_OUT,
        choices: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        self.record, self.verb = record, tuple(verb)
        found = {f.name: f for f in _fields(record, choices or {})}
        if unknown := [name for name in only if name not in found]:
            raise InputError(f"expected some of {', '.join(found)}, got {', '.join(unknown)}", field="only")
        kept = [found[name] for name in only] if only else list(found.values())
        self.fields = tuple(f for f in kept if f.name not in without)

    def field(self, name: str) -> FormField:
        """Return one field."""
        return next(f for f in self.fields if f.name == name)

    def changed(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values that are others than the defaults; those of fields that are not shown are left out."""
        defaults = {f.name: f for f in self.fields}
        return {
            name: value for name, value in values.items()
            if name in defaults and not _same(value, defaults[name].default)
        }  # fmt: skip

    def made(self, values: Mapping[str, Any]) -> T:
        """Return the record with the values put in.

        Raises
        ------
        InputError
            If a value is of the wrong type, or cannot be right.
        """
        return merge(self.record, _nested(self.changed(values)), "here")

    def errors(self, values: Mapping[str, Any]) -> dict[str, str]:
        """Return what is wrong, by the name of the field; under "" what is wrong of several."""
        found: dict[str, str] = {}
        changed = self.changed(values)
        for name, value in changed.items():
            try:
                merge(self.record, _nested({name: value}), "here")
            except InputError as error:
                found[name] = _said(str(error), name)
        rest = {name: value for name, value in changed.items() if name not in found}
        try:
            merge(self.record, _nested(rest), "here")
        except InputError as error:
            named = str(error).partition(":")[0].strip()
            where = next((f.name for f in self.fields if f.name.rpartition(".")[2] == named), "")
            found[where] = _said(str(error), where)
        # a setting that is right only beside another one is no fault of either
        for name in [name for name in found if name and self._right(values, name)]:
            del found[name]
        return found

    def _right(self, values: Mapping[str, Any], name: str) -> bool:
        """Whether all together are accepted."""
        try:
            self.made(values)
        except InputError:
            return False
        return True

    def arguments(self, values: Mapping[str, Any]) -> list[str]:
        """Return the arguments of nerif: the verb, and the flags of what is not as by default."""
        changed = self.changed(values)
        words = [word for f in self.fields if f.name in changed for word in f.words(changed[f.name])]
        return [*self.verb, *words]


def _fields(record: Any, choices: Mapping[str, Sequence[str]], prefix: str = "") -> list[FormField]:
    """The fields of a record, those of records among its fields in their place."""
    cls, found = type(record), []
    for name, where in flat_names(cls).items():
        holder = getattr(record, where[0]) if len(where) == 2 else record
        hint = typing.get_type_hints(type(holder), include_extras=True)[name]
        if typing.get_origin(hint) is typing.Annotated:
            if tyro.conf.Suppress in hint.__metadata__:
                continue
            hint = hint.__origin__
        value = getattr(holder, name)
        if dataclasses.is_dataclass(value):
            found += _fields(value, choices, f"{prefix}{name}.")
            continue
        default = None if value in MISSING else value
        text = help_of(type(holder), name)
        kind, optional = _kind(hint)
        words = tuple(choices.get(prefix + name, ())) or (choices_of(holder, name) if kind == "text" else ())
        kind = "choice" if words else kind
        numbers = kind in ("integer", "number") or (kind == "words" and "str" not in str(hint))
        unit = _unit(text) if numbers else ""
        found.append(FormField(prefix + name, kind, text, unit, default, words, optional))
    return found


def _kind(hint: Any) -> tuple[str, bool]:
    """How a field is asked for, and whether it may be None."""
    options = typing.get_args(hint) if typing.get_origin(hint) in (types.UnionType, typing.Union) else (hint,)
    optional = type(None) in options
    hint = next(o for o in options if o is not type(None))
    hint = hint.__origin__ if typing.get_origin(hint) is typing.Annotated else hint
    if typing.get_origin(hint) is tuple:
        return "words", optional
    kinds = {bool: "switch", int: "integer", float: "number", str: "text", Path: "text"}
    return kinds.get(hint, "text"), optional


def choices_of(record: Any, name: str) -> tuple[str, ...]:
    """Return the words that a record lets a field be, by what it says of another one; empty if it takes any."""
    try:
        return _choices(record, name)
    except TypeError:  # a record that cannot be hashed
        return ()


@cache
def _choices(record: Any, name: str) -> tuple[str, ...]:
    try:
        dataclasses.replace(record, **{name: "?"})
    except InputError as error:
        listed = re.search(r"expected (?:one of )?([\w+., -]+?)(?:,? got| \(|;|$)", str(error))
        words = re.split(r",? or |, ", listed[1]) if listed else []
        return tuple(dict.fromkeys(words)) if all(_accepts(record, name, w) for w in words) else ()
    return ()


def _accepts(record: Any, name: str, word: str) -> bool:
    try:
        dataclasses.replace(record, **{name: word})
    except InputError:
        return False
    return True


def _unit(text: str) -> str:
    """The unit that a help text ends its first clause with."""
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
    """Values as a settings file has them: those of network.width in a table `network`."""
    table: dict[str, Any] = {}
    for name, value in values.items():
        *groups, last = name.split(".")
        inner = table
        for group in groups:
            inner = inner.setdefault(group, {})
        inner[last] = list(value) if isinstance(value, tuple) else value
    return table


def _said(message: str, name: str) -> str:
    """The message beside its field, which need not be named again."""
    message = re.sub(r"^here(?: \[\w+\])?: ", "", message)
    short = re.sub(rf"^'?{re.escape(name.rpartition('.')[2])}'?(?: = [^:]*)?: ", "", message)
    return short[:1].upper() + short[1:]
