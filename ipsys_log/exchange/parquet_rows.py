"""Parquet files of rows, with nested columns."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.log.atomic_files import replacement_of

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

    Raises
    ------
    IpsysError
        PyArrow is not installed.
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
