"""Settings: frozen dataclasses whose annotations state type, choices and limits, and whose texts below the fields help.

norm: Literal["l2", "squared"] = "squared"
voxels: Annotated[int, Ge(1)] = 64
betas: Annotated[tuple[float, float], Developer] = (0.9, 0.99)

Values from Python, a settings file, the command line and a form are converted and checked by the same annotations, and
the same fields are the options of the command line, the controls of a form, and their help. Choices that are the keys
of a registry (Literal[*METHODS]) are read from it whenever they are needed, since annotations are texts.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import itertools
import json
import math
import textwrap
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from annotated_types import Ge, Gt, Lt

from nerif.common.conventions import InputError
from nerif.common.files import check_known

__all__ = [
    "FORMER", "MISSING", "Append", "Checked", "Count", "Developer", "Flat", "Length", "Natural", "NoOption",
    "NonNegative", "Option", "OptionName", "Positional", "Positive", "changes_to", "check_settings", "converted",
    "merge", "options", "with_present_names",
]  # fmt: skip

T = TypeVar("T")

Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]
Count = Annotated[int, Ge(1)]
Natural = Annotated[int, Ge(0)]
Length = Annotated[float, Gt(0), Lt(math.inf)]

MISSING: Any = dataclasses.MISSING
"""The value of a field that is required and not given yet."""

FORMER = {"source": "from", "probes": "known", "grow": "extend_open_faces", "drawn": "drawings"}
"""Former names of options and their present ones, valid until 1.0 where an option of the former name is none."""

EXPECTED = {  # by the type of an error of pydantic
    "greater_than": "a number above {gt:g}", "greater_than_equal": "{ge:g} or more",
    "less_than": "a number below {lt:g}", "less_than_equal": "{le:g} or less",
    "int_type": "a whole number", "int_parsing": "a whole number", "int_from_float": "a whole number",
    "float_type": "a number", "float_parsing": "a number", "bool_type": "true or false",
    "bool_parsing": "true or false", "string_type": "a text", "path_type": "a path", "tuple_type": "a list of values",
    "dict_type": "names with values",
}  # fmt: skip
SHORT = {"a number above 0": "a positive number", "a number below inf": "a finite number"}
VALUES = {int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH", bool: ""}


@dataclass(frozen=True)
class OptionName:
    """Marks a field whose option has another name, since that of the option is a word of Python."""

    name: str


Flat, Positional, Developer, NoOption, Append = (object() for _ in range(5))
"""Further marks of fields: a record whose fields are options without its name in front; a word without a name on the
command line; set by --set and settings files only; no option; one value each time that the option is given."""


def check_settings(settings: Any) -> None:
    """Convert every field of a frozen dataclass to the type of its annotation; InputError if a value is invalid."""
    for name, hint in _hints(type(settings)).items():
        value = getattr(settings, name)
        if value is not MISSING and _holds_values(hint):
            object.__setattr__(settings, name, converted(hint, value, name))


@dataclass(frozen=True)
class Checked:
    """A record whose fields are converted and checked when it is made."""

    def __post_init__(self) -> None:
        check_settings(self)


def converted(hint: Any, value: Any, name: str, file: bool = False) -> Any:
    """Return a value as the type of an annotation.

    Parameters
    ----------
    name : of the setting, for the InputError
    file : whether the value is from a file or form, where the text "3" is no number; else words are converted
    """
    from pydantic import ValidationError

    adapter = _adapter(hint)
    try:
        if file:
            return adapter.validate_json(json.dumps(value, default=str), strict=True)
        return adapter.validate_python(value)
    except ValidationError as error:
        expected = " or ".join(dict.fromkeys(_expected(dict(line), hint) for line in error.errors()))
    words = isinstance(value, list) and all(isinstance(word, str) for word in value)
    raise InputError(f"expected {expected}, got {' '.join(value) if words else repr(value)}", field=name)


@functools.cache
def _adapter(hint: Any) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(hint)


def _expected(error: dict[str, Any], hint: Any) -> str:
    """Return what was expected in place of an invalid value."""
    kind, context = error["type"], error.get("ctx", {})
    if kind == "literal_error":
        choices = [word for word in context["expected"].replace("'", "").replace(" or ", ", ").split(", ") if word]
        return f"one of {', '.join(choices)}" if choices[1:] else choices[0]
    if kind in ("missing", "too_long"):
        (parts,) = (typing.get_args(part) for part in _alternatives(hint) if typing.get_origin(part) is tuple)
        return f"{_group(parts[0])} values each" if Ellipsis in parts else f"{len(parts)} values"
    text = EXPECTED.get(kind, error["msg"].lower()).format(**context)
    return SHORT.get(text, text)


def with_present_names(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings that a result or store holds, by the present names of options."""
    return {FORMER.get(name, name): value for name, value in entries.items()}


# -- options ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Option:
    """A field of settings, or of settings within them."""

    name: str  #: network.width for the field `width` of the record `network`
    place: tuple[str, ...]  #: names of the fields that lead to it
    hint: Any  #: type, with choices and limits
    default: Any  #: MISSING if it is required
    marks: tuple[Any, ...]  #: of the field, such as Developer
    owner: type  #: class that has the field

    @property
    def flag(self) -> str:
        """The name on the command line."""
        return "--" + self.name.replace("_", "-")

    @property
    def label(self) -> str:
        """What the command line and its errors call it."""
        return self.name if Positional in self.marks else self.flag

    @property
    def off(self) -> str:
        """The name that turns a switch off."""
        group, dot, last = self.flag[2:].rpartition(".")
        return f"--{group}{dot}no-{last}"

    @property
    def help(self) -> str:
        """The text below the field in its class or in a base class; empty if there is none."""
        texts = (_texts(kind).get(self.place[-1]) for kind in self.owner.__mro__)
        return next(filter(None, texts), "")

    @property
    def kind(self) -> str:
        """What sets it: switch, choice, integer, number, words (several values) or text."""
        (first, *others) = (part for part in _alternatives(self.hint) if part is not types.NoneType)
        origin = typing.get_origin(first)
        if origin in (tuple, dict):
            return "words"
        if origin is Literal:
            return "text" if others else "choice"
        return {bool: "switch", int: "integer", float: "number"}.get(first, "text")

    @property
    def choices(self) -> tuple[str, ...]:
        """Valid words; empty for other kinds than a choice."""
        return typing.get_args(_alternatives(self.hint)[0]) if self.kind == "choice" else ()

    @property
    def optional(self) -> bool:
        """Whether None is valid."""
        return types.NoneType in _alternatives(self.hint)

    @property
    def count(self) -> int | None:
        """Number of its words on the command line, None for any number."""
        first = _alternatives(self.hint)[0]
        if typing.get_origin(first) not in (tuple, dict) or Append in self.marks:
            return 1
        parts = typing.get_args(first)
        return None if Ellipsis in parts else len(parts)

    @property
    def is_table(self) -> bool:
        """Whether it holds names with values, one pair each time that it is given."""
        return typing.get_origin(_alternatives(self.hint)[0]) is dict

    @property
    def values(self) -> str:
        """The values that it takes, as in help: choices or types."""
        return _shown(self.hint)

    def value(self, words: list[str]) -> Any:
        """Return the words of the command line as a value to be converted."""
        if words == ["None"] and self.optional:
            return None
        if self.kind != "words":
            return " ".join(words)
        size = _group(typing.get_args(_alternatives(self.hint)[0])[0])
        return [words[i : i + size] for i in range(0, len(words), size)] if size else words


def options(record: Any) -> dict[str, Option]:
    """Return the options of settings by name; defaults are the values of the record."""
    return {option.name: option for option in _options(record)}


def _options(record: Any, prefix: str = "", place: tuple[str, ...] = ()) -> Iterator[Option]:
    for name, hint in _hints(type(record)).items():
        marks = hint.__metadata__ if typing.get_origin(hint) is Annotated else ()
        value = getattr(record, name)
        if NoOption in marks:
            continue
        if dataclasses.is_dataclass(value):
            yield from _options(value, prefix if Flat in marks else f"{prefix}{name}.", (*place, name))
            continue
        label = next((mark.name for mark in marks if isinstance(mark, OptionName)), name)
        yield Option(prefix + label, (*place, name), hint, value, marks, type(record))


def merge(record: T, values: Mapping[str, Any], place: object = "", file: bool = True) -> T:
    """Return settings with other values, by the names of options; network.width may be `width` in the table `network`.

    Parameters
    ----------
    place : file in which the values stand, named by an InputError
    file : whether they are values of a file or form; else words of the command line
    """
    fields, changes = options(record), dict[tuple[str, ...], Any]()
    values = dict(_flattened(values, fields))
    check_known(values, fields, str(place))
    try:
        for name, value in values.items():
            option = fields[name]
            changes[option.place] = converted(option.hint, value, name if file else option.flag, file)
        return _replaced(record, changes, {o.place: name if file else o.label for name, o in fields.items()})
    except InputError as error:
        raise error.inside(place) if place else error from None


def _flattened(values: Mapping[str, Any], fields: Mapping[str, Option], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        name = prefix + name.replace("-", "_")
        if isinstance(value, Mapping) and name not in fields:
            yield from _flattened(value, fields, f"{name}.")
        else:
            yield name, value


def _replaced(record: T, changes: Mapping[tuple[str, ...], Any], names: Mapping[tuple[str, ...], str]) -> T:
    """Return settings with changes by place; an InputError has the `names` of options."""
    fields = {place[0]: value for place, value in changes.items() if len(place) == 1}
    for name in dict.fromkeys(place[0] for place in changes if len(place) > 1):
        inner, inner_names = (
            {place[1:]: value for place, value in mapping.items() if place[0] == name} for mapping in (changes, names)
        )
        fields[name] = _replaced(getattr(record, name), inner, inner_names)
    try:
        return dataclasses.replace(record, **fields)  # type: ignore[type-var]
    except InputError as error:
        raise error.renamed({place[0]: name for place, name in names.items() if len(place) == 1}) from None


# -- types and texts -------------------------------------------------------------------------------------------------


def _hints(cls: type) -> dict[str, Any]:
    hints = typing.get_type_hints(cls, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def _plain(hint: Any) -> Any:
    return hint.__origin__ if typing.get_origin(hint) is Annotated else hint


def _alternatives(hint: Any) -> list[Any]:
    """Return the types of a union, or the type, without limits and marks."""
    hint = _plain(hint)
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return [part for argument in typing.get_args(hint) for part in _alternatives(argument)]
    return [hint]


def _holds_values(hint: Any) -> bool:
    """Whether a type is that of a setting: numbers, texts, paths, choices, and tuples and tables of these."""
    for part in _alternatives(hint):
        inner = typing.get_args(part)
        if typing.get_origin(part) in (tuple, dict):
            if not all(each is Ellipsis or _holds_values(each) for each in inner):
                return False
        elif typing.get_origin(part) is not Literal and part not in (*VALUES, types.NoneType):
            return False
    return True


def _group(hint: Any) -> int:
    """Return the number of values of a tuple; 0 for other types."""
    return len(typing.get_args(hint)) if typing.get_origin(hint) is tuple else 0


def _shown(hint: Any) -> str:
    texts = []
    for part in _alternatives(hint):
        inner = typing.get_args(part)
        if typing.get_origin(part) is Literal:
            texts.append("{" + ",".join(map(str, inner)) + "}")
        elif typing.get_origin(part) in (tuple, dict):
            texts.append(" ".join("..." if each is Ellipsis else _shown(each) for each in inner))
        elif part is not types.NoneType:
            texts.append(VALUES[part])
    return " or ".join(texts)


@functools.cache
def changes_to(settings: type) -> type:
    """Return a class of changes to settings: the same fields, each None where nothing is changed."""
    names = [(name, hint | None, None) for name, hint in _hints(settings).items()]
    namespace = {"__post_init__": check_settings, "settings": settings}
    return dataclasses.make_dataclass(f"ChangesTo{settings.__name__}", names, frozen=True, namespace=namespace)


@functools.cache
def _texts(cls: type) -> dict[str, str]:
    """Return the texts below the fields of a class, by name."""
    cls = getattr(cls, "settings", cls)
    try:
        body = typing.cast(ast.ClassDef, ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]).body
    except (OSError, TypeError):  # a class without source
        return {}
    return {
        node.target.id: " ".join(below.value.value.split())
        for node, below in itertools.pairwise(body)
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
        and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str)
    }  # fmt: skip
