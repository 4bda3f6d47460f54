"""Files of rows: CSV with a header, with errors by file and line; and Parquet with nested columns."""

import csv
import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.log.atomic_files import replacement_of

Value = TypeVar("Value")
_LONGEST_TEXT = 40


@contextmanager
def open_as_text(path: Path) -> Iterator[None]:
    """Give the errors of the operating system and of the decoders one line."""
    try:
        yield
    except OSError as error:
        raise IpsysError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise IpsysError(f"{path}: is not a text file with a table: {error}") from error


def read_cells(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of the header, and of each row that is not blank."""
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


def find_delimiter(line: str) -> str:
    """Return the separator of the cells of a line; spreadsheets in many languages do not use commas."""
    return next((mark for mark in (";", "\t") if mark in line), ",")


def with_decimal_point(text: str) -> str:
    """Return a number with a decimal point instead of its decimal comma."""
    return text.replace(",", ".") if text.count(",") == 1 and "." not in text else text


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


def read_named_rows(path: Path, needed: Collection[str]) -> Iterator[NamedRow]:
    """Yield the rows of a CSV file; more columns than the needed ones are allowed."""
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
    """Return a finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise IpsysError(f"{where}: {text.strip()[:_LONGEST_TEXT]!r} is not a number; {advice}")
    return value


# The type of each column by its name: a plain type, or the columns of the items of a list.
Columns = Mapping[str, "str | Columns"]
_MARK = b"ipsys"
_LIST = re.compile(r"list<(\w+)>")


def write_rows(path: Path, rows: Iterable[Mapping[str, Any]], columns: Columns, mark: str = "") -> None:
    """Write rows as a Parquet file; the file is replaced when it is complete.

    Parameters
    ----------
    rows : by row, the value of each column; a missing one is null. Times are integers in ns; the file has
        them in us and without a time zone, because DuckDB has few functions for any others. Texts are those
        of :func:`escape_surrogates`.
    columns : the type of each column, such as ``int64``, ``list<string>`` or ``time``; the columns of the
        items for a list of rows.
    mark : a text that :func:`read_rows` returns.
    """
    check_installed("Parquet files need", "pyarrow")
    import pyarrow as pa
    from pyarrow import parquet

    schema = pa.schema(_fields(columns)).with_metadata({_MARK: mark})
    table = pa.Table.from_pylist([escape_surrogates(dict(row)) for row in rows], schema=schema)
    table = _with_times(table, pa.timestamp("us"))
    with replacement_of(path) as file:
        parquet.write_table(table, file, compression="zstd")


def read_rows(path: Path) -> tuple[str | None, list[dict[str, Any]]]:
    """Return the mark and the rows of a file of :func:`write_rows`; None and no rows of any other file.

    Times are integers in ns, rounded down to us.

    Raises
    ------
    IpsysError
        The file is no Parquet file, or PyArrow is not installed.
    """
    check_installed("Parquet files need", "pyarrow")
    import pyarrow as pa
    from pyarrow import parquet

    try:
        table = parquet.read_table(path)
    except (pa.ArrowException, OSError) as error:
        cause = str(error).partition("\n")[0]
        raise IpsysError(f"{path}: cannot be read as a Parquet file ({cause}); choose another name") from None
    mark = (table.schema.metadata or {}).get(_MARK)
    if mark is None:
        return None, []
    table = _with_times(_with_times(table, pa.timestamp("ns")), pa.int64())
    rows: list[dict[str, Any]] = table.to_pylist()
    return mark.decode(), rows


def escape_surrogates(value: Any) -> Any:
    r"""Return a value whose texts can be stored: bytes of a file name that are not UTF-8 become escapes.

    Parameters
    ----------
    value : a text, or a list, a tuple or a dict with texts at any depth; other values stay as they are.

    Examples
    --------
    >>> escape_surrogates(["red.mcap", "red\udcff.mcap", 7])
    ['red.mcap', 'red\\udcff.mcap', 7]
    """
    if isinstance(value, str):
        return value if value.isascii() else value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, dict):
        return {key: escape_surrogates(item) for key, item in value.items()}
    return [escape_surrogates(item) for item in value] if isinstance(value, (list, tuple)) else value


def _with_times(table: Any, kind: Any) -> Any:
    """Return a table whose columns of times have another type."""
    import pyarrow as pa

    for number, field in enumerate(table.schema):
        if pa.types.is_timestamp(field.type):
            table = table.set_column(number, field.name, table.column(number).cast(kind, safe=False))
    return table


def _fields(columns: Columns) -> list[Any]:
    import pyarrow as pa

    def kind(text: str | Columns) -> Any:
        if not isinstance(text, str):
            return pa.list_(pa.struct(_fields(text)))
        if items := _LIST.fullmatch(text):
            return pa.list_(pa.type_for_alias(items[1]))
        return pa.timestamp("ns") if text == "time" else pa.type_for_alias(text)

    return [pa.field(name, kind(text)) for name, text in columns.items()]
