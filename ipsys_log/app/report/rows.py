"""One model of a table, for a terminal and for a page; and lengths and shares as its cells."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from textwrap import wrap
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from ipsys_log.plain_text import plain_text
from ipsys_log.units import CM_PER_M, MM_PER_M

_WIDTH = 80
_UNKNOWN = "-"
Cell = str | Text


@dataclass(frozen=True, slots=True)
class Rows:
    """A table: the names of its columns, and rows of cells.

    Attributes
    ----------
    title : title on a terminal; a page has its own headings.
    columns : names of the columns. A ``>`` before a name marks a column of numbers.
    cells : the rows. Cells at the end of a row may be missing.
    note : text below the table on a terminal.
    groups : titles above columns on a page, each with the number of its columns.
    """

    title: str
    columns: Sequence[str]
    cells: Sequence[Sequence[Cell]]
    note: str = ""
    groups: Sequence[tuple[str, int]] = field(default=())

    @property
    def heads(self) -> list[tuple[str, bool]]:
        """The names of the columns, each with True for a column of numbers."""
        return [(name.removeprefix(">"), name.startswith(">")) for name in self.columns]

    def __rich__(self) -> Group:
        """Return the table for a terminal of 80 columns; names from a log are only text there."""
        rows = [[cell if isinstance(cell, Text) else name_cell(cell) for cell in row] for row in self.cells]
        table = Table(box=None, pad_edge=False, padding=(0, 2 if self._is_narrow(rows) else 1, 0, 0))
        for name, is_number in self.heads:
            # A number that does not fit must not look like another number.
            look: dict[str, Any] = {"justify": "right", "no_wrap": True, "overflow": "ellipsis"}
            table.add_column(Text(name), **(look if is_number else {"overflow": "fold"}))
        for row in rows:
            table.add_row(*row)
        title = [Text(wrap_text(plain_text(self.title)), style="bold")] if self.title else []
        note = [Text(wrap_text(plain_text(self.note, keep="\n")))] if self.note else []
        return Group(*title, table, *note)

    def _is_narrow(self, rows: Sequence[Sequence[Text]]) -> bool:
        """Return whether 80 columns have room for two spaces between the columns of the table."""
        widths = [len(name) for name, _ in self.heads]
        for row in rows:
            for number, cell in enumerate(row):
                widths[number] = max(widths[number], *map(len, cell.plain.split("\n")))
        return sum(widths) + 2 * (len(widths) - 1) <= _WIDTH


def name_cell(text: str) -> Text:
    """Return a name from a log, without control characters for a terminal or a table."""
    return Text(plain_text(text, keep="\n"))


def wrap_text(text: str, indent: str = "") -> str:
    """Wrap lines between words; later lines have the indentation of the first."""
    parts = (
        wrap(part, _WIDTH, initial_indent=indent, subsequent_indent=indent) for part in text.splitlines()
    )
    return "\n".join(line for lines in parts for line in lines)


def cm(length_m: float | None, digits: int = 2) -> str:
    """Format a length in cm; several decimals are left out from 1 m on, and a dash stands for None.

    Examples
    --------
    >>> cm(0.01234), cm(0.01234, 3), cm(1.2346), cm(1.2346, 1), cm(None)
    ('1.23', '1.234', '123', '123.5', '-')
    """
    if length_m is None:
        return _UNKNOWN
    length_cm = length_m * CM_PER_M
    return f"{length_cm:.{digits if abs(length_cm) < 100 or digits < 2 else 0}f}"


def means_cm(*means_m: float) -> list[str]:
    """Format mean errors in cm with two decimals; with three if some values look equal otherwise.

    Examples
    --------
    >>> means_cm(0.0062, 0.0051), means_cm(0.00184, 0.00177, 0.00176)
    (['0.62', '0.51'], ['0.184', '0.177', '0.176'])
    """
    short, long = (
        [cm(mean_m, digits) if mean_m < 1 else "over 100" for mean_m in means_m] for digits in (2, 3)
    )
    return short if len(set(short)) == len(set(long)) else long


def mm(length_m: float | None, digits: int = 1) -> str:
    """Format a length in mm, or return a dash if it is not known."""
    return _UNKNOWN if length_m is None else f"{length_m * MM_PER_M:.{digits}f}"


def ms(time_s: float | None, digits: int = 1) -> str:
    """Format a time in ms, or return a dash if it is not known."""
    return _UNKNOWN if time_s is None else f"{1e3 * time_s:.{digits}f}"


def percent(share: float | None, digits: int = 0) -> str:
    """Format a share in %, or return a dash if it is not known."""
    return _UNKNOWN if share is None else f"{100 * share:.{digits}f} %"


def counted(number: int, what: str) -> str:
    """Return a number with its noun, such as ``1 point`` and ``2 points``."""
    return f"{number} {what}{'' if number == 1 else 's'}"
