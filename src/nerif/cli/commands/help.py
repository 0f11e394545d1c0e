"""Help of commands with many options: the frequent ones in groups; `--help all` shows the rest."""

from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
import types
import typing
from typing import Any, Literal

from nerif.cli.arguments import ALIASES
from nerif.cli.commands.settings import flat_names, help_of

__all__ = ["GROUPS", "after_help"]

WIDTH, INDENT = 100, 26

GROUPS: dict[str, tuple[str, ...]] = {
    "data": ("source", "withhold", "open_faces", "lower", "upper", "start_from"),
    "method": ("method", "preset", "symmetry", "refine", "seed", "device"),
    "limits": ("time_limit", "max_steps", "iterations"),
    "frames": ("chunk", "warm_steps", "velocity", "quantities", "retry"),
    "computers": ("cluster", "workers", "dashboard"),
    "outputs": ("out", "voxels", "report", "force", "resume"),
    "uncertainty": ("uncertainty",),
}
"""Options that people set, by group."""


def after_help(arguments: list[str], default: Any, prog: str) -> list[str]:
    """Return the arguments for the parser, which prints every option; print the frequent ones of --help, and end."""
    if arguments[-2:] == ["--help", "all"]:
        return arguments[:-1]
    if {"-h", "--help"} & {*arguments}:
        print(_grouped(default, prog))
        raise SystemExit(0)
    return arguments


def _grouped(default: Any, prog: str) -> str:
    """Return the help of a command: usage, the options of GROUPS, and where the others are."""
    names, description = flat_names(type(default)), inspect.getdoc(type(default)) or ""
    lines = [
        f"usage: {prog} MEASUREMENT --out OUT [options]",
        "",
        *"\n\n".join(textwrap.fill(text, WIDTH) for text in description.split("\n\n")).splitlines(),
    ]
    for group, options in GROUPS.items():
        if usable := [name for name in options if name in names]:
            lines += ["", f"{group}:", *(line for name in usable for line in _option(default, names[name]))]
    lines += [
        "",
        "--help all lists every option. Any of them can also be given as --set NAME=VALUE, such as",
        "--set network.width=128, or in a settings file: --config FILE.toml.",
    ]
    return "\n".join(lines)


def _option(default: Any, place: tuple[str, ...]) -> list[str]:
    """Return the lines of an option: flag and values, help text, default."""
    owner = default if len(place) == 1 else getattr(default, place[0])
    name = place[-1]
    hint, value = typing.get_type_hints(type(owner), include_extras=True)[name], getattr(owner, name)
    flags = [f"--{flag}" for flag, field in ALIASES.items() if field == name] or [f"--{name.replace('_', '-')}"]
    if name == "out":
        flags.insert(0, "-o")
    text = re.sub(r" \(also --[\w-]+\)", "", " ".join(help_of(type(owner), name).split()))
    if isinstance(value, bool):
        flags.append(f"--no-{name.replace('_', '-')}")
    elif isinstance(value, str | int | float | tuple) and value != () and "default:" not in text:
        words = " ".join(map(str, value)) if isinstance(value, tuple) else f"{value}"
        text = f"{text} (default: {words})"
    head = f"  {', '.join(flags)} {_values(hint)}".rstrip()
    body = textwrap.wrap(text, WIDTH, initial_indent=" " * INDENT, subsequent_indent=" " * INDENT)
    if body and len(head) < INDENT - 1:
        return [head.ljust(INDENT) + body[0].strip(), *body[1:]]
    return [head, *body]


def _values(hint: Any) -> str:
    """Return the values that an option takes: choices, or the kind of value."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _values(parts[0])
    if origin is Literal:
        return "{" + ",".join(map(str, parts)) + "}"
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(v for part in parts if part is not type(None) and (v := _values(part))))
    if origin is tuple:
        return f"{_values(parts[0])} ..."
    kinds = {int: "INT", float: "FLOAT", str: "TEXT", bool: ""}
    return kinds.get(hint, "" if dataclasses.is_dataclass(hint) else "PATH")
