"""Tables of numbers as text: any encoding that spreadsheets write, separator, decimal comma, and names of columns."""

from __future__ import annotations

import codecs
import itertools
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.files import check_file, reading

__all__ = ["UNIT", "TextTable", "read_numbers", "text_of"]

NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eEdD][+-]?\d+)?|[+-]?nan|[+-]?inf", re.IGNORECASE)
UNIT = re.compile(r"\s*[\[(]([^\])]*)[\])]")
NAME = re.compile(r'"([^"]*)"|((?:[^\s,;"\[(]+)(?:\s*(?:\[[^\]]*\]|\([^)]*\)))*)')
MAX_HEAD_LINES = 200  # before the first row of numbers


@dataclass(frozen=True)
class TextTable:
    """Columns of numbers."""

    names: tuple[str, ...]  #: of the columns, without units; empty if the file has none
    units: tuple[str, ...]  #: of the columns, "" if unknown
    values: np.ndarray  #: (row, column), NaN where a cell is empty
    head: tuple[str, ...]  #: lines before the first row of numbers


def text_of(path: Path) -> str:
    """Return the text of a file in UTF-8, in UTF-16 with its mark (Excel's Unicode text) or in Windows-1252."""
    content = path.read_bytes()
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encodings = ["utf-16"]
    else:
        encodings = [] if b"\0" in content else ["utf-8-sig", "cp1252"]
    for encoding in encodings:
        with suppress(UnicodeDecodeError):
            return content.decode(encoding)
    raise InputError("not a text file in UTF-8 or UTF-16", field=path)


def read_numbers(path: Path, least: int = 4) -> TextTable:
    """Read rows of at least `least` numbers under a head of any lines, of which one may name the columns."""
    check_file(path, "text file")
    lines = text_of(path).splitlines()
    start, separator = next(
        ((i, sep) for i, line in enumerate(lines[:MAX_HEAD_LINES]) if (sep := _separator(line, least))), (-1, "")
    )
    if start < 0:
        raise InputError(f"expected rows of at least {least} numbers, got none", field=path)
    cells = _cells(lines[start], separator)
    commas = separator != "," and any("," in cell for cell in cells)
    body = list(itertools.takewhile(lambda line: _is_row(line, separator), filter(str.strip, lines[start:])))
    if commas:
        body = [line.replace(",", ".") for line in body]
    options: dict[str, Any] = {"delimiter": None if separator == " " else separator, "comments": None, "ndmin": 2}
    try:
        values = np.loadtxt(body, **options)
    except ValueError:  # cells are empty
        with reading("cannot be read as a table of numbers", path):
            values = np.genfromtxt(body, **options, usecols=range(len(cells)))
    names = _names(lines[:start], len(cells), separator)
    plain = tuple(UNIT.sub("", name).strip(' #%"') for name in names)
    units = tuple(match[-1].strip() if (match := UNIT.findall(name)) else "" for name in names)
    return TextTable(plain, units, values, tuple(lines[:start]))


def _is_row(line: str, separator: str) -> bool:
    """Whether a line begins with a number; some programs add a footer."""
    return bool(NUMBER.fullmatch(_cells(line, separator)[0]))


def _cells(line: str, separator: str) -> list[str]:
    cells = line.split() if separator == " " else line.strip().rstrip(separator).split(separator)
    return [cell.strip() for cell in cells]


def _separator(line: str, least: int) -> str:
    """Return the separator of a row of numbers (some cells may be empty); "" for any other line."""
    for separator in ("\t", ";", ",", " "):
        cells = _cells(line, separator)
        numbers = [cell for cell in cells if NUMBER.fullmatch(cell)]
        if len(numbers) >= least and len(numbers) >= len(cells) - 2 and all(NUMBER.fullmatch(c) for c in cells[:2]):
            return separator
    return ""


def _names(head: list[str], count: int, separator: str) -> tuple[str, ...]:
    """Return the names in the last line of a head that has as many as there are columns; none if there is none."""
    for line in reversed(head):
        _, tecplot, variables = line.partition("VARIABLES")
        text = variables if tecplot else line.lstrip("#% \t").rstrip("\r\n")
        if tecplot:
            names = re.findall(r'"([^"]*)"', text)[:count]
        elif separator != " " and text.count(separator) >= count - 1:
            names = [name.strip(' "') for name in text.split(separator)]
        else:
            names = [quoted or plain for quoted, plain in NAME.findall(text)]
        while len(names) > count and not names[-1]:
            names.pop()
        if len(names) == count and not any(NUMBER.fullmatch(name) for name in names):
            return tuple(names)
    return ()
