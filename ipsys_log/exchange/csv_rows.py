"""Rows of CSV files with a header; errors name the file and the line."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, TypeVar

from ipsys_log.errors import IpsysError

Value = TypeVar("Value")
_LONGEST_TEXT = 40


@contextmanager
def open_as_text(path: Path) -> Iterator[None]:
    """Give the errors of the operating system and of the decoders one line.

    Raises
    ------
    IpsysError
        The file cannot be read, or is no text file.
    """
    try:
        yield
    except OSError as error:
        raise IpsysError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise IpsysError(f"{path}: is not a text file with a table: {error}") from error


def read_cells(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of the header, and of each row that is not blank.

    Raises
    ------
    IpsysError
        The file is empty, or a row has another number of cells than the header.
    """
    with path.open(newline="", encoding="utf-8-sig") as file:
        table = csv.reader(file)
        header = next(table, None)
        if header is None:
            raise IpsysError(f"{path}: is empty; export it again from the other system")
        yield table.line_num, header
        for cells in table:
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != len(header):
                raise IpsysError(
                    f"{path}: line {table.line_num}: has {len(cells)} cells, but the header has {len(header)}"
                )
            yield table.line_num, cells


class NamedRow(NamedTuple):
    """A row of a file: its place in errors, and its cells by the names of the columns."""

    where: str
    cells: dict[str, str]

    def text(self, name: str) -> str:
        """Return a cell without blanks around it; empty if there is no such column."""
        return self.cells.get(name, "").strip()

    def number(self, name: str) -> float:
        """Return the number in a cell."""
        return parse_number(self.text(name), f"{self.where}: {name}", "write one")

    def integer(self, name: str) -> int:
        """Return the integer in a cell."""
        return self._parse(name, int, "an integer")

    def optional(self, name: str, parse: Callable[[str], Value]) -> Value | None:
        """Return the parsed cell; None if it is empty, or if there is no such column."""
        return parse(name) if self.text(name) else None

    def _parse(self, name: str, parse: Callable[[str], Value], kind: str) -> Value:
        text = self.text(name)
        try:
            return parse(text)
        except ValueError as error:
            raise IpsysError(f"{self.where}: {name}: {text[:_LONGEST_TEXT]!r} is not {kind}") from error


def read_rows(path: Path, needed: Collection[str]) -> Iterator[NamedRow]:
    """Yield the rows of a CSV file; more columns than the needed ones are allowed.

    Raises
    ------
    IpsysError
        The file cannot be read, has no such column, or a column twice.
    """
    with open_as_text(path):
        cells = read_cells(path)
        header = [name.strip().lower() for name in next(cells)[1]]
        if missing := [name for name in needed if name not in header]:
            raise IpsysError(f"{path}: the header has no column {', '.join(missing)}; add it")
        for name in needed:
            if header.count(name) > 1:
                raise IpsysError(f"{path}: the header has the column {name} twice; remove one")
        for line, values in cells:
            yield NamedRow(f"{path}: line {line}", dict(zip(header, values, strict=True)))


def parse_number(text: str, where: str, advice: str) -> float:
    """Return a finite number.

    Raises
    ------
    IpsysError
        The text is no number, or is infinite.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise IpsysError(f"{where}: {text.strip()[:_LONGEST_TEXT]!r} is not a number; {advice}")
    return value
