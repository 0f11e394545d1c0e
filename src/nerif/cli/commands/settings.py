"""Settings of a command: defaults, overridden by a TOML file (--config), overridden by options.

Names in the file are those of the options; --network.width is `width` in the table [network].
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
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

import tyro

from nerif.cli.arguments import ALIASES, flag_value, words_of
from nerif.common.conventions import InputError
from nerif.common.files import check_known, local_path, read_toml
from nerif.common.settings import check_settings

__all__ = [
    "COMMAND_LINE_ONLY",
    "Flat",
    "Settings",
    "command",
    "flat_names",
    "help_of",
    "merge",
    "parse",
    "read_settings",
    "setting_of",
]

T = TypeVar("T")

Flat = tyro.conf.arg(name="")
"""Marks a field whose own fields are options without a prefix."""
IGNORED_TABLES = ("about",)  # results in run.toml
COMMAND_LINE_ONLY = ("allowed_host", "cluster", "dashboard", "force", "host", "root_path")
"""Options that run code of another machine or a shell (cluster), open the app or a port to others, or overwrite files:
a file, which may come from another person, cannot set them."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of every command."""

    config: Path | None = None
    """TOML file of settings, such as the run.toml of a result; options override it."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if isinstance(value := getattr(self, field.name), Path):
                object.__setattr__(self, field.name, local_path(value, Path(), field.name))
        check_settings(self)

    @classmethod
    def read(cls, arguments: list[str], name: str) -> Self:
        """Return the settings of a command by the arguments of the command line."""
        required = [f.name for f in dataclasses.fields(cls) if f.default is f.default_factory is dataclasses.MISSING]
        return read_settings(cls(**dict.fromkeys(required, tyro.MISSING)), arguments, name)


S = TypeVar("S", bound=Settings)


def command(name: str, settings: type[S], run: Callable[[S], object]) -> Callable[[list[str]], None]:
    """Return the function that parses the arguments of a command and runs it."""

    def main(arguments: list[str]) -> None:
        run(settings.read(arguments, name))

    return main


def read_settings(default: T, arguments: list[str], name: str, file: Path | None = None) -> T:
    """Return the settings of a command.

    Parameters
    ----------
    default : settings with tyro.MISSING for required ones
    arguments : of the command line, without the command
    name : of the command
    file : settings file without --config
    """
    if file := _config(arguments) or file:
        default = merge(default, _settings_file(file), str(file))
    return parse(default, arguments, f"nerif {name}", inspect.getdoc(type(default)) or "")


def setting_of(name: str, arguments: list[str], default: str, file: Path | None = None) -> str:
    """Return a single setting on which the defaults of others depend."""
    file = _config(arguments) or file
    value = flag_value(arguments, f"--{name}") or (_settings_file(file).get(name) if file is not None else None)
    return str(value or default)


def _config(arguments: list[str]) -> Path | None:
    config = flag_value(arguments, "--config")
    return Path(config) if config else None


def _settings_file(path: Path) -> dict[str, Any]:
    entries = {k: v for k, v in read_toml(path, "settings file (--config)").items() if k not in IGNORED_TABLES}
    for name in entries:
        if (option := name.replace("-", "_")) in COMMAND_LINE_ONLY:
            option = option.replace("_", "-")
            raise InputError(f"expected no '{name}' in a file; give --{option} on the command line", field=path)
    return entries


def flat_names(cls: type) -> dict[str, tuple[str, ...]]:
    """Map the name of each option to its place: the fields of a field marked Flat are options of their own."""
    names: dict[str, tuple[str, ...]] = {}
    for name, hint in _hints(cls).items():
        if typing.get_origin(hint) is typing.Annotated and getattr(hint.__metadata__[0], "name", None) == "":
            names |= {f.name: (name, f.name) for f in dataclasses.fields(hint.__origin__)}
        else:
            names[name] = (name,)
    return names


def _hints(cls: type) -> dict[str, Any]:
    hints = typing.get_type_hints(cls, include_extras=True)
    return {f.name: hints[f.name] for f in dataclasses.fields(cls)}


def merge(default: T, values: dict[str, Any], source: str) -> T:
    """Return settings with the values of a file, each checked against its type."""
    names = flat_names(type(default))
    flat: dict[str, dict[str, Any]] = {}
    changes: dict[str, Any] = {}
    values = {ALIASES.get(key, key.replace("-", "_")): value for key, value in values.items()}
    check_known(values, names, source)
    for key, value in values.items():
        if len(names[key]) == 2:
            flat.setdefault(names[key][0], {})[key] = value
        elif dataclasses.is_dataclass(getattr(default, key)) and isinstance(value, dict):
            changes[key] = merge(getattr(default, key), value, f"{source} [{key}]")
        else:
            changes[key] = _typed(typing.get_type_hints(type(default))[key], key, value, source)
    changes |= {name: merge(getattr(default, name), inner, source) for name, inner in flat.items()}
    try:
        return dataclasses.replace(default, **changes)  # type: ignore[type-var]
    except InputError as error:  # a choice or limit (common/settings.py)
        raise error.inside(source) from None


def _typed(hint: Any, name: str, value: Any, source: str) -> Any:
    from pydantic import TypeAdapter, ValidationError

    try:
        return TypeAdapter(hint).validate_json(json.dumps(value, default=str), strict=True)
    except ValidationError as error:
        reason = error.errors()[0]["msg"].lower()
        raise InputError(f"'{name}' = {value!r}: {reason}", field=source) from None


def parse(default: T, arguments: list[str], prog: str, description: str) -> T:
    """Parse the arguments of a command; an InputError has the error of tyro in one line."""
    arguments = words_of(arguments)
    error = io.StringIO()
    try:
        with contextlib.redirect_stderr(error):
            return tyro.cli(type(default), prog=prog, description=description, args=arguments, default=default)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise InputError(_one_line(error.getvalue(), prog)) from None


def _one_line(box: str, prog: str) -> str:
    """Reduce the error box of tyro to its first sentence and the nearest option."""
    plain = re.sub(r"\x1b\[[0-9;]*m|[│╭╮╰╯─]+|[-|+]{5,}", " ", box)
    lines = [line.strip() for line in plain.splitlines()]
    text = " ".join([line for line in lines if line][1:])
    text = re.split(r"\s*(?:For full helptext|Argument helptext)", text)[0].rstrip(". ")
    text = re.sub(r"^Error parsing [A-Z]\w*: ", "", text)
    text = re.sub(r"\s+", " ", text)
    text = re.sub(r" Perhaps you meant: (--[\w.-]+|-\w, --[\w.-]+).*", r"; did you mean \1?", text)
    return f"{text}; see {prog} --help"


def help_of(cls: type, name: str) -> str:
    """Return the text below a field in its class or in a base class; empty if there is none."""
    return next((text for kind in cls.__mro__ if (text := _texts(kind).get(name))), "")


@functools.cache
def _texts(cls: type) -> dict[str, str]:
    """Return the texts below the fields of a class, by name."""
    if not dataclasses.is_dataclass(cls):
        return {}
    try:
        body = typing.cast(ast.ClassDef, ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]).body
    except OSError:  # a class without source
        return {}
    return {
        node.target.id: inspect.cleandoc(below.value.value)
        for node, below in itertools.pairwise(body)
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
        and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str)
    }  # fmt: skip
