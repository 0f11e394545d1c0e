"""The arguments of a command, checked before anything is imported that takes seconds.

options.json has, for each command and choice of its options, the values of every option; `python -m
nerif.cli.arguments` writes it from the settings. What is not refused here, the parser of the command checks.
"""

from __future__ import annotations

import itertools
import json
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from nerif.common.conventions import InputError
from nerif.common.files import ending, instead_of_file

__all__ = ["ALIASES", "INPUTS", "check_arguments", "check_output", "flag_value", "table", "words_of"]

MEASUREMENT = "no such file; expected a measurement (NetCDF-4, BOST-1.1)"
RESULT = "no such directory; expected one written by nerif reconstruct"
INPUTS = {
    "calibrate": "no such file or folder; expected images of a target, a calibration file or a measurement",
    "displacement": "no such folder; expected one with a folder for each view",
    "mask": MEASUREMENT,
    "body": MEASUREMENT,
    "check": "no such file or store; expected a measurement (.nc), or one over time (.zarr)",
    "reconstruct": MEASUREMENT,
    "project": RESULT,
    "evaluate": f"{RESULT}, or a store (.zarr) of nerif sequence",
    "sequence": "no such store; expected a measurement sequence (Zarr, BOST-1.1)",
    "movie": "no such store; expected volumes over time (Zarr)",
    "report": f"{RESULT}, or a store (.zarr) of nerif sequence",
    "figures": RESULT,
    "export": f"{RESULT}, or a measurement (--format astra or tigre)",
    "app": "no such folder; expected a folder to work in",
    "info": "no such file or folder; expected a measurement, volume or result",
}
"""Commands whose first word is a file or folder to read, with the error where it does not exist."""
MAKES_INPUT = {"app": "--demo"}
"""Commands with an option that makes the file or folder of their first word."""
OUTPUTS = ("design", "pattern", "mask", "body", "check", "simulate", "project", "movie", "export")
"""Commands that write a file (--out), and overwrite none without --force."""
OPTIONS = Path(__file__).with_name("options.json")
ALIASES: dict[str, str] = {"from": "source", "drawn": "drawings", "known": "probes"}
"""Further names of options, and those of their fields."""
VARIANTS = {"reconstruct": ("--method", "METHODS"), "pattern": ("--kind", "KINDS")}
"""The option on which the others of a command depend, and the name of its choices in the module of the command."""
FILES = ("--config", "--resume")
"""Options with which the others of such a command may come from a file."""
NUMBERS = {"INT": int, "FLOAT": float}


def check_arguments(command: str, arguments: list[str]) -> None:
    """Raise InputError for an input that does not exist, a wrong option or value, or an output file that exists."""
    first = arguments[0] if arguments else ""
    words = words_of(arguments)
    if {"-h", "--help"} & {*words}:
        return
    is_read = command in INPUTS and MAKES_INPUT.get(command) not in words
    if is_read and first and not first.startswith("-"):
        if not os.path.lexists(first):
            raise InputError(INPUTS[command], field=first)
        if os.path.exists(first) and not (os.path.isfile(first) or os.path.isdir(first)):
            raise InputError(instead_of_file(Path(first)), field=first)
    _check_options(command, words)
    out = flag_value(words, "-o", "--out")
    if command in OUTPUTS and out is not None and os.path.isfile(out) and "--force" not in words:
        check_output(Path(out), force=False)


def _check_options(command: str, words: list[str]) -> None:
    values, (variant, _) = dict(_options(words)), VARIANTS.get(command, ("", ""))
    choice = values.get(variant)
    commands = json.loads(OPTIONS.read_text(encoding="utf-8"))
    options = commands.get(f"{command} {variant} {choice}" if choice else command)
    if options is None or (variant and values.keys() & {*FILES}):
        return  # a method that is not in the table yet, or one from a file
    see = f"; see nerif {command} --help"
    for name in options["required"]:
        if flag_value(words, name, "-o" if name == "--out" else name) is None and "--config" not in values:
            raise InputError(f"expected {options[name]}, got none{see}", field=name)
    for name, value in _options(words):
        if name not in options:
            import difflib

            nearest = difflib.get_close_matches(name, options, n=1)
            guess = f"; did you mean {nearest[0]}?" if nearest else ""
            raise InputError(f"unknown option{guess}{see}", field=name)
        kind = options[name]
        if value in (None, "None"):
            continue
        if isinstance(kind, list) and value not in kind:
            raise InputError(f"expected one of {', '.join(kind)}, got '{value}'{see}", field=name)
        if isinstance(kind, str) and kind in NUMBERS and not _is_number(value, NUMBERS[kind]):
            whole = "whole " if kind == "INT" else ""
            raise InputError(f"expected a {whole}number, got '{value}'{see}", field=name)


def words_of(arguments: list[str]) -> list[str]:
    """Return the arguments of a command, with --set NAME=VALUE as --NAME VALUE and options by the names of fields."""
    words = [word for pair in _with_set(arguments) for word in pair]
    return [re.sub(r"^--([\w.-]+)", lambda m: f"--{ALIASES.get(m[1], m[1].replace('_', '-'))}", a) for a in words]


def _with_set(arguments: list[str]) -> Iterator[list[str]]:
    words = iter(arguments)
    for word in words:
        if word != "--set":
            yield [word]
            continue
        name, _, value = next(words, "").partition("=")
        if not name or not value:
            raise InputError(f"expected NAME=VALUE, such as network.width=128, got '{name}'", field="set")
        yield [f"--{name}", *value.split()]


def flag_value(arguments: list[str], *flags: str) -> str | None:
    """Return the value of an option before the command line is parsed."""
    for i, word in enumerate(arguments):
        for flag in flags:
            if word == flag and i + 1 < len(arguments):
                return arguments[i + 1]
            if flag.startswith("--") and word.startswith(flag + "="):
                return word.split("=", 1)[1]
    return None


def _options(words: list[str]) -> Iterator[tuple[str, str | None]]:
    """Yield the options among words, each with its first value."""
    for word, after in itertools.pairwise([*words, ""]):
        if match := re.fullmatch(r"(--[a-z][\w.-]*)(?:=(.*))?", word, re.DOTALL):
            value = match[2] if match[2] is not None else after
            yield match[1], None if match[2] is None and (not after or after.startswith("--")) else value


def _is_number(text: str, kind: type[int] | type[float]) -> bool:
    try:
        kind(text)
    except ValueError:
        return False
    return True


def check_output(path: Path, force: bool, *others: Path, endings: tuple[str, ...] = ()) -> None:
    """Check the ending of an output file (--out), that its folder exists, and that nothing is overwritten unasked.

    Parameters
    ----------
    others : files written beside it
    """
    if endings and ending(path) not in endings:
        raise InputError(f"expected a name ending in {' or '.join(endings)}, got '{path.name}'", field="out")
    for file in (path, *others):
        if not file.parent.is_dir():
            raise InputError(f"the folder {file.parent} does not exist; create it", field=file)
        if file.is_dir() and ending(file) != ".zarr":
            raise InputError("expected the name of a file, got a folder", field=file)
        if file.exists() and not force:
            raise InputError("exists already and was left as it is; give another --out, or --force", field=file)


def table() -> dict[str, dict[str, Any]]:
    """Return the table from the settings of all commands."""
    import importlib
    from unittest.mock import patch

    from nerif.cli.cli import COMMANDS, MODULES
    from nerif.cli.commands import settings

    class Parsed(Exception):
        """The settings of a command."""

    def parse(default: object, *_: object) -> None:
        raise Parsed(default)

    def parsed(main: Callable[[list[str]], None], *words: str) -> dict[str, Any]:
        try:
            main([*words])
        except Parsed as stop:
            return _values(stop.args[0])
        raise AssertionError("a command parses its arguments")

    entries: dict[str, dict[str, Any]] = {}
    with patch.object(settings, "parse", parse):
        for command in COMMANDS:
            module = importlib.import_module(MODULES.get(command, f"nerif.cli.commands.{command}"))
            entries[command] = parsed(module.main)
            if command in VARIANTS:
                variant, choices = VARIANTS[command]
                entries[command][variant] = [*getattr(module, choices)]
                for choice in entries[command][variant]:
                    entries[f"{command} {variant} {choice}"] = parsed(module.main, variant, choice)
    return entries


def _values(default: object) -> dict[str, Any]:
    """Return the options of settings: the choices or kind of their values, "" for none; and those that are required."""
    import warnings

    import tyro

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        parser = tyro.extras.get_parser(type(default), default=default)
    options: dict[str, Any] = {"required": []}
    for action in parser._actions:
        kind = sorted(action.choices) if action.choices else action.metavar if action.nargs == 1 else ""
        names = [name for name in action.option_strings if name.startswith("--") and name != "--help"]
        options |= dict.fromkeys(names, kind or "")
        options["required"] += names[:1] if action.required else []
    return options


if __name__ == "__main__":
    OPTIONS.write_text(json.dumps(table(), indent=1) + "\n", encoding="utf-8")
