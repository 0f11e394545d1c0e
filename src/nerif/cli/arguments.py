"""The words after a command: checks that need no settings, and the values of options."""

from __future__ import annotations

import difflib
import os
import re
import sys
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from nerif.common.conventions import InputError
from nerif.common.files import ending, instead_of_file
from nerif.common.settings import FORMER, Append, Developer, Option, Positional

__all__ = ["INPUTS", "check_arguments", "check_output", "flag_value", "present_name", "values_of"]

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


def check_arguments(command: str, words: list[str]) -> None:
    """Raise InputError for an input that does not exist or an output file that exists, before any heavy import."""
    first = words[0] if words else ""
    if {"-h", "--help"} & {*words}:
        return
    is_read = command in INPUTS and MAKES_INPUT.get(command) not in words
    if is_read and first and not first.startswith("-"):
        if not os.path.lexists(first):
            raise InputError(INPUTS[command], field=first)
        if os.path.exists(first) and not (os.path.isfile(first) or os.path.isdir(first)):
            raise InputError(instead_of_file(Path(first)), field=first)
    out = flag_value(words, "out")
    if command in OUTPUTS and out is not None and os.path.isfile(out) and "--force" not in words:
        check_output(Path(out), force=False)


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


def flag_value(words: list[str], name: str) -> str | None:
    """Return the value of an option of one word, before the other options of the command are known."""
    value = None
    for flag, (first, *_) in ((flag, rest or [""]) for flag, rest in _given(words)):
        if flag == f"--{name}" and first:
            value = first
        elif flag == "--set" and first.startswith(f"{name}="):
            value = first.partition("=")[2]
    return value


def values_of(words: list[str], fields: Mapping[str, Option]) -> dict[str, Any]:
    """Return the values of options by name, as words to be converted.

    Parameters
    ----------
    fields : options of the command, by name
    """
    values: dict[str, Any] = {}
    free = [option for option in fields.values() if Positional in option.marks]
    off = {option.off: option.name for option in fields.values() if option.kind == "switch"}
    for flag, rest in _given(words):
        if flag == "--set":
            name, _, value = (rest or [""])[0].partition("=")
            if not name or not value:
                raise InputError(f"expected NAME=VALUE, such as network.width=128, got '{name}'", field=flag)
            option, rest = _option(f"--{name}", fields, all_options=True), rest[1:]
            _put(values, option, value.split())
        elif flag in off:
            values[off[flag]] = False
        elif flag:
            option = _option(flag, fields)
            count = 0 if option.kind == "switch" else option.count
            _put(values, option, rest[:count] if option.kind != "switch" else ["true"])
            rest = [] if count is None else rest[count:]
        for word in rest:
            if not free:
                raise InputError(f"expected the name of an option, got '{word}'", field=word)
            _put(values, free[0], [*values.get(free[0].name, []), word] if free[0].count is None else [word])
            free = free if free[0].count is None else free[1:]
    return values


def present_name(name: str, fields: Collection[str]) -> str:
    """Return the name of an option, with underscores; a note on standard error where another one takes its place."""
    name = name.replace("-", "_")
    now = FORMER.get(name, name)
    if name in fields or now not in fields:
        return name
    old, new = (word.replace("_", "-") for word in (name, now))
    print(f"nerif: note: --{old} is now --{new}; the former name is valid until nerif 1.0", file=sys.stderr)
    return now


def _given(words: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield each option with the words up to the next; first those before any, without one."""
    flag, rest = "", list[str]()
    for word in words:
        if not word.startswith("-") or word == "-" or _is_number(word):
            rest.append(word)
            continue
        yield flag, rest
        flag, equals, value = word.partition("=")
        rest = [value] if equals else []
        if match := re.fullmatch("-o(.*)", flag):
            flag, rest = "--out", [match[1]] if match[1] else rest
        flag = flag.replace("_", "-")
    yield flag, rest


def _option(flag: str, fields: Mapping[str, Option], all_options: bool = False) -> Option:
    """Return an option by its name on the command line; those of developers among all options only."""
    option = fields.get(present_name(flag[2:], fields))
    if option is None or Positional in option.marks or not flag.startswith("--"):
        flags = [option.flag for option in fields.values() if Positional not in option.marks]
        nearest = difflib.get_close_matches(flag, flags, n=1)
        guess = f"; did you mean {nearest[0]}?" if nearest else ""
        raise InputError(f"unknown option{guess}", field=flag)
    if Developer in option.marks and not all_options:
        raise InputError(f"expected --set {option.name}=VALUE, or {option.name} in a settings file", field=flag)
    return option


def _put(values: dict[str, Any], option: Option, words: list[str]) -> None:
    if not words and option.count is not None:
        raise InputError(f"expected {option.values}, got none", field=option.flag)
    if option.is_table:
        if len(words) != option.count:
            raise InputError(f"expected {option.values}, got {' '.join(words)}", field=option.flag)
        values[option.name] = {**values.get(option.name, {}), words[0]: words[1]}
    elif Append in option.marks:
        values[option.name] = [*values.get(option.name, []), *words]
    else:
        values[option.name] = option.value(words)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
