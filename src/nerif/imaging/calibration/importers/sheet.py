"""A .csv file of any spreadsheet: its separator, decimal commas, and the names of its columns."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from nerif.common.conventions import InputError
from nerif.common.text_tables import text_of

__all__ = ["Sheet", "read_sheet"]


@dataclass(frozen=True)
class Sheet:
    """Rows of cells, without empty lines and comments."""

    path: Path
    separator: str
    rows: list[list[str]]
    lines: list[int]  #: numbers of the rows in the file, from 1

    def table(self, columns: Sequence[str], number_columns: Collection[str]) -> list[tuple[int, dict[str, str]]]:
        """Return number and cells of each line below the first, without empty cells, numbers with decimal points.

        Parameters
        ----------
        columns : names of the columns, "" for one without a name
        """
        if twice := [name for name, count in Counter(filter(None, columns)).items() if count > 1]:
            raise InputError(f"expected each column once, got '{twice[0]}' twice", field=self.path)
        cells: list[tuple[int, str, str]] = []
        for line, row in zip(self.lines[1:], self.rows[1:], strict=True):
            if any(row[len(columns) :]):
                raise InputError(
                    f"line {line}: expected {len(columns)} columns, got {len(row)}; separate them by semicolons if the "
                    "numbers have decimal commas",
                    field=self.path,
                )
            cells += [(line, name, cell) for name, cell in zip(columns, row, strict=False) if cell]
        texts = [cell if name in number_columns else "" for _, name, cell in cells]
        tables: dict[int, dict[str, str]] = {}
        for (line, name, cell), number in zip(cells, self.decimal_points(texts), strict=True):
            tables.setdefault(line, {})[name] = number or cell
        return list(tables.items())

    def decimal_points(self, texts: Sequence[str]) -> list[str]:
        """Return the texts of numbers with decimal points instead of commas."""
        commas = any("," in text for text in texts)
        if commas and (self.separator == "," or any("." in text for text in texts)):
            raise InputError(
                "expected numbers with decimal points, such as 1500.5, or with decimal commas in a table separated by "
                "semicolons or tabs, got commas and points, or commas in quotes; remove separators of thousands",
                field=self.path,
            )
        return [text.replace(",", ".") for text in texts]


def read_sheet(path: Path) -> Sheet:
    """Read the cells of a file, separated by tabs, semicolons or commas."""
    numbered = [(i, text) for i, text in enumerate(text_of(path).splitlines(), 1) if text.strip()]
    numbered = [(i, text) for i, text in numbered if not text.lstrip().startswith("#")]
    if numbered and (match := re.fullmatch(r"sep=(.)\s*", numbered[0][1], re.IGNORECASE)):  # Excel's own first line
        numbered, separator = numbered[1:], match[1]
    else:
        separator = next((c for c in "\t;" if numbered and c in numbered[0][1]), ",")
    cells = csv.reader((text for _, text in numbered), delimiter=separator, skipinitialspace=True)
    rows = [[cell.strip() for cell in row] for row in cells]
    return Sheet(path, separator, rows, [i for i, _ in numbered][: len(rows)])
