"""Help of a command: its options in groups; of commands with many options the frequent ones, all by `--help all`."""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Iterable
from typing import Any

from nerif.common.settings import MISSING, Developer, Option, Positional, options

__all__ = ["GROUPS", "help_text"]

WIDTH, INDENT = 100, 26

GROUPS: dict[str, tuple[str, ...]] = {
    "data": ("from", "withhold", "open_faces", "lower", "upper", "start_from"),
    "method": ("method", "preset", "symmetry", "refine", "seed", "device"),
    "limits": ("time_limit", "max_steps", "iterations"),
    "frames": ("chunk", "warm_steps", "velocity", "quantities", "retry"),
    "computers": ("cluster", "workers", "dashboard"),
    "outputs": ("out", "voxels", "report", "force", "resume"),
    "uncertainty": ("uncertainty",),
}
"""Options that people set, by group."""
MORE = """
--help all lists every option. Any of them can also be given as --set NAME=VALUE, such as
--set network.width=128, or in a settings file: --config FILE.toml."""


def help_text(record: Any, prog: str, everything: bool = False) -> str:
    """Return the help of a command: usage, description, options.

    Parameters
    ----------
    record : settings of the command, with their defaults
    everything : also the options that are rarely set
    """
    fields = {name: option for name, option in options(record).items() if Developer not in option.marks}
    places = [option for option in fields.values() if Positional in option.marks]
    needed = [option for option in fields.values() if option.default is MISSING and option not in places]
    words = [option.name.upper() if option.default is MISSING else f"[{option.name.upper()}]" for option in places]
    words += [f"{option.flag} {option.name.upper()}" for option in needed]
    lines = [f"usage: {' '.join([prog, *words])} [options]", ""]
    for paragraph in (inspect.getdoc(type(record)) or "").split("\n\n"):
        lines += [*textwrap.wrap(paragraph, WIDTH), ""]
    if few := record.brief and not everything:
        groups = {group: [fields[name] for name in names if name in fields] for group, names in GROUPS.items()}
    else:
        groups = {"arguments": places, "options": []}
        for option in (option for option in fields.values() if option not in places):
            groups.setdefault(option.name.rpartition(".")[0] or "options", []).append(option)
    for group, members in groups.items():
        if members:
            lines += [f"{group}:", *(line for option in members for line in _lines(option)), ""]
    return "\n".join([*lines[:-1], *(MORE.splitlines() if few else [])])


def _lines(option: Option) -> Iterable[str]:
    """Return the lines of an option: its names and values, its text, its default."""
    text, value = option.help, option.default
    if Positional in option.marks:
        head = f"  {option.name.upper()}"
    else:
        names = ["-o"] * (option.name == "out") + [option.flag] + [option.off] * (option.kind == "switch")
        head = f"  {', '.join(names)} {option.values}".rstrip()
    if isinstance(value, str | int | float | tuple) and not isinstance(value, bool) and value not in ("", ()):
        words = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
        text += f" (default: {words})" * ("default:" not in text)
    body = textwrap.wrap(text, WIDTH, initial_indent=" " * INDENT, subsequent_indent=" " * INDENT)
    if body and len(head) < INDENT - 1:
        return [head.ljust(INDENT) + body[0].strip(), *body[1:]]
    return [head, *body]
