"""From the command line and a TOML file to a checked record of settings.

    nerif VERB --config FILE.toml --flag VALUE          the defaults, over them the file, over it the flags

The names in the file are those of the flags; a nested flag such as --network.width stands in the table [network].
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import inspect
import io
import itertools
import json
import re
import textwrap
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import tyro

from nerif.common.conventions import InputError
from nerif.common.files import check_known, read_toml

__all__ = ["Flat", "Settings", "flag_value", "flat_names", "help_of", "merge", "parse", "read_settings", "value_given"]

T = TypeVar("T")

Flat = tyro.conf.arg(name="")
"""Marks a field whose record stands among the other settings, without a prefix."""

ALIASES = {"from": "source"}
"""Names that settings may be given by, beside their own: words that Python keeps for itself."""

IGNORED = ("about",)  # the table of run.toml that tells what came out


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What the settings of every verb hold."""

    config: Path | None = None
    """TOML file of settings (such as the run.toml of a result); flags win over it."""


def read_settings(default: T, arguments: list[str], verb: str, file: Path | None = None) -> T:
    """Return the settings of a verb: `default`, over it the settings file, over that the flags.

    Parameters
    ----------
    default : a record with tyro.MISSING where there is no default
    arguments : of the command line, without the verb
    verb : its name
    file : settings file where --config names none

    Raises
    ------
    InputError
        If file or flags are not such settings.
    """
    file = _config(arguments) or file
    if file is not None:
        default = merge(default, _settings_file(file), str(file))
    return parse(default, arguments, f"nerif {verb}", inspect.getdoc(type(default)) or "")


def value_given(name: str, arguments: list[str], default: str, file: Path | None = None) -> str:
    """Return what flag or settings file say of one setting on which the defaults of the others depend."""
    file = _config(arguments) or file
    given = flag_value(arguments, f"--{name}") or (_settings_file(file).get(name) if file is not None else None)
    return str(given or default)


def _config(arguments: list[str]) -> Path | None:
    config = flag_value(arguments, "--config")
    return Path(config) if config else None


def _settings_file(path: Path) -> dict[str, Any]:
    return {k: v for k, v in read_toml(path, "settings file (--config)").items() if k not in IGNORED}


def flat_names(cls: type) -> dict[str, tuple[str, ...]]:
    """Map each name a user may give to where it stands: fields of a record annotated name="" stand at the top."""
    names: dict[str, tuple[str, ...]] = {}
    for field in dataclasses.fields(cls):
        inner = _inner_record(cls, field.name)
        if inner is not None:
            names |= {f.name: (field.name, f.name) for f in dataclasses.fields(inner)}
        else:
            names[field.name] = (field.name,)
    return names


def _hint(cls: type, name: str) -> Any:
    return typing.get_type_hints(cls, include_extras=True)[name]


def _inner_record(cls: type, name: str) -> type | None:
    """The record behind a field whose own name is left out of the flags."""
    hint = _hint(cls, name)
    if typing.get_origin(hint) is typing.Annotated and getattr(hint.__metadata__[0], "name", None) == "":
        return typing.cast(type, hint.__origin__)
    return None


def merge(default: T, values: dict[str, Any], source: str) -> T:
    """Return a record with the values of a settings file put in, each checked against its type.

    Raises
    ------
    InputError
        If a key is unknown (the nearest known one is named) or a value is of the wrong type.
    """
    cls = type(default)
    names = flat_names(cls)
    groups: dict[str, dict[str, Any]] = {}
    changes: dict[str, Any] = {}
    values = {ALIASES.get(key, key.replace("-", "_")): value for key, value in values.items()}
    check_known(values, names, source)
    for key, value in values.items():
        where = names[key]
        if len(where) == 2:
            groups.setdefault(where[0], {})[where[1]] = value
        elif dataclasses.is_dataclass(getattr(default, key)) and isinstance(value, dict):
            changes[key] = merge(getattr(default, key), value, f"{source} [{key}]")
        else:
            changes[key] = _typed(cls, key, value, source)
    for name, inner in groups.items():
        changes[name] = merge(getattr(default, name), inner, source)
    return dataclasses.replace(default, **changes)  # type: ignore[type-var]


def _typed(cls: type, name: str, value: Any, source: str) -> Any:
    from pydantic import TypeAdapter, ValidationError

    try:
        return TypeAdapter(_hint(cls, name)).validate_json(json.dumps(value, default=str), strict=True)
    except ValidationError as error:
        detail = error.errors()[0]
        raise InputError(f"'{name}' = {value!r}: {detail['msg'].lower()}", field=source) from None


def flag_value(arguments: list[str], *flags: str) -> str | None:
    """Return the value of a flag before the whole line is parsed: it decides what the defaults are."""
    for i, word in enumerate(arguments):
        for flag in flags:
            if word == flag and i + 1 < len(arguments):
                return arguments[i + 1]
            if flag.startswith("--") and word.startswith(flag + "="):
                return word.split("=", 1)[1]
    return None


def parse(default: T, arguments: list[str], prog: str, description: str) -> T:
    """Parse the arguments of a verb; those not given keep the values of `default`.

    Raises
    ------
    InputError
        In one line, where the library would draw a box.
    """
    arguments = [
        re.sub(r"^--([\w.-]+)", lambda m: f"--{ALIASES.get(m[1], m[1].replace('_', '-'))}", a) for a in arguments
    ]
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(type(default), prog=prog, description=description, args=arguments, default=default)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise InputError(_one_line(said.getvalue(), prog)) from None


def _one_line(box: str, prog: str) -> str:
    """Reduce the library's box to its first sentence and the nearest option it offers."""
    lines = [re.sub(r"[│╭╮╰╯─]+", " ", re.sub(r"\x1b\[[0-9;]*m", "", line)).strip() for line in box.splitlines()]
    lines = [line for line in lines if line][1:]
    text = " ".join(lines)
    text = re.split(r"\s*(?:For full helptext|Argument helptext)", text)[0]
    text = re.sub(r"\s+", " ", text)
    text = re.sub(r" Perhaps you meant: (--[\w.-]+|-\w, --[\w.-]+).*", r"; perhaps you meant \1", text)
    return f"{text}; see {prog} --help"


def help_of(cls: type, name: str) -> str:
    """Return the text below a field of a record, as its class or the one it has it from says it; empty if none does."""
    for kind in cls.__mro__:
        if name in vars(kind).get("__annotations__", {}):
            return _texts(kind).get(name, "")
    return ""


@functools.cache
def _texts(cls: type) -> dict[str, str]:
    """The text below each field, by name."""
    body = typing.cast(ast.ClassDef, ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]).body
    return {
        node.target.id: inspect.cleandoc(below.value.value)
        for node, below in itertools.pairwise(body)
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
        and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str)
    }  # fmt: skip
