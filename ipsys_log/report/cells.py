"""Cells and text of tables on a terminal of 80 columns."""

from __future__ import annotations

from collections.abc import Iterable
from textwrap import wrap

from rich.table import Table
from rich.text import Text

from ipsys_log.messages import ErrorStatistics
from ipsys_log.plain_text import plain_text
from ipsys_log.units import CM_PER_M

__all__ = ["format_interval", "name_cell", "plain_table", "wrap_text"]

_WIDTH = 80


def plain_table(title: str, names: Iterable[str], figures: Iterable[str] = ()) -> Table:
    """Return a table without lines: columns of names to the left, columns of figures to the right."""
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    table.padding = (0, 1, 0, 0)
    for column in names:
        table.add_column(column, overflow="fold")
    for column in figures:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def name_cell(text: str) -> Text:
    """Return a name from a log, without control characters for a terminal or a table."""
    return Text(plain_text(text))


def wrap_text(text: str, indent: str = "") -> str:
    """Wrap lines between words; later lines have the indentation of the first."""
    parts = (
        wrap(part, _WIDTH, initial_indent=indent, subsequent_indent=indent) for part in text.splitlines()
    )
    return "\n".join(line for lines in parts for line in lines)


def format_interval(errors: ErrorStatistics) -> str:
    """The 95 % confidence interval of a mean in cm, or a dash."""
    if errors.mean_low_m is None or errors.mean_high_m is None:
        return "-"
    digits = 2 if errors.mean_high_m * CM_PER_M < 100 else 0
    return f"{errors.mean_low_m * CM_PER_M:.{digits}f}-{errors.mean_high_m * CM_PER_M:.{digits}f}"
