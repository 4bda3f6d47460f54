"""The table of a catalogue: a Parquet file that is brought up to date, log by log."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ipsys_log.api.catalogue.row import COLUMNS, Baseline, read_row, state_columns
from ipsys_log.engine.graph import VERSIONS
from ipsys_log.engine.output import derived_log_of
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.parquet_rows import escape_surrogates, read_rows, write_rows
from ipsys_log.log.location import LogLocation
from ipsys_log.log.log_files import read_log_state, states_below

# Raised when a row gets another content for the same log.
_VERSION = 3
_KIND = "catalogue "


@dataclass(frozen=True, slots=True)
class CatalogueUpdate:
    """The update of a catalogue.

    Attributes
    ----------
    logs : the number of logs in the catalogue.
    read : the number of logs that were read, because they are new or have changed.
    removed : the number of logs that do not exist any more.
    errors : the reason by log, for logs that cannot be read.
    """

    logs: int
    read: int
    removed: int
    errors: Mapping[str, str]


def update_catalogue(
    folder: LogLocation,
    target: Path,
    baseline: Baseline | None = None,
    derived: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> CatalogueUpdate:
    """Write the catalogue of all logs below a folder; only new or changed logs are read.

    A log is read again if its size, change time or, in a store, its ETag differs. All logs are read again if
    the stages of this ipsys have other versions, or the baseline differs: states and drift depend on these.
    A log that cannot be appended to is read with its derived log, which then has no row of its own.

    Parameters
    ----------
    folder : a folder, or the URL of one, or a URL with a pattern. Logs are named by their path below it.
    target : the Parquet file. The rows of an earlier catalogue in it are used again.
    baseline : for the drift of the cameras since then; None: no drift.
    derived : the folder of derived logs; None: the working folder.
    progress : called with the number of logs done, and of all logs.

    Raises
    ------
    IpsysError
        There is no such folder, it has no logs and had none before, a store cannot be listed, PyArrow is not
        installed, or the target is another file.
    """
    logs = {escape_surrogates(name): (log, state) for name, log, state in states_below(folder)}
    mark = _mark(baseline)
    before = _earlier_rows(target, mark) if target.exists() else {}
    if not logs and not before:
        raise IpsysError(f"{folder}: has no file that ends in .mcap; name another folder")
    derived_of = _derived_logs([log for log, _ in logs.values()], derived)
    own = {path.resolve() for path in derived_of.values()}
    logs = {name: row for name, row in logs.items() if _resolved(row[0]) not in own}
    rows: list[dict[str, Any]] = []
    read = 0
    for number, (name, (log, state)) in enumerate(logs.items()):
        progress(number, len(logs))
        results = derived_of.get(log)
        row, columns = before.get(name), state_columns(state, results)
        if row is None or any(row[key] != value for key, value in columns.items()):
            row, read = read_row(log, name, columns, baseline, results), read + 1
        rows.append(row)
    progress(len(logs), len(logs))
    write_rows(target, rows, COLUMNS, mark)
    errors = {row["log"]: row["error"] for row in rows if row.get("error")}
    return CatalogueUpdate(len(rows), read, len(before.keys() - logs.keys()), errors)


def _derived_logs(logs: Iterable[LogLocation], folder: Path | None) -> dict[LogLocation, Path]:
    """Return the derived logs that exist, by their log."""
    derived = {log: derived_log_of(log, folder) for log in logs}
    return {log: path for log, path in derived.items() if path is not None and path.is_file()}


def _resolved(log: LogLocation) -> Path | None:
    return log.resolve() if isinstance(log, Path) else None


def _earlier_rows(target: Path, mark: str) -> dict[str, dict[str, Any]]:
    """Return the rows of a catalogue by log; none of a catalogue with another mark."""
    found, rows = read_rows(target)
    if not (found or "").startswith(_KIND):
        raise IpsysError(f"{target}: is not a catalogue, so it is not replaced; choose another name")
    return {row["log"]: row for row in rows} if found == mark else {}


def _mark(baseline: Baseline | None) -> str:
    """Return the identity of all on which a row depends besides its log."""
    logs = [] if baseline is None else [baseline.log, baseline.model_from]
    states = [[_name(log), state_columns(read_log_state(log))] for log in logs]
    parts = json.dumps([_VERSION, VERSIONS, states], sort_keys=True)
    return _KIND + hashlib.blake2b(parts.encode(), digest_size=16).hexdigest()


def _name(log: LogLocation) -> str:
    return str(log.resolve() if isinstance(log, Path) else log)
