"""The catalogue of a folder: a Parquet table with a row for each log, brought up to date log by log."""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ipsys_log.api.python_api import ModelEvaluation
from ipsys_log.engine.graph import VERSIONS
from ipsys_log.engine.output import check_source, derived_log_of
from ipsys_log.engine.states import recorded_stages
from ipsys_log.errors import IpsysError, os_error_text, reason_without
from ipsys_log.exchange.row_files import Columns, escape_surrogates, read_rows, write_rows
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation, LogState
from ipsys_log.log.log_files import read_log_state, states_below
from ipsys_log.messages.channels import EVALUATION, EVENTS, MEASUREMENTS
from ipsys_log.tools.cut import outdated_runs
from ipsys_log.tools.recording import find_gaps
from ipsys_log.units import NS_PER_S

COLUMNS: Columns = {
    "log": "string",
    "bytes": "int64",
    "changed_ns": "int64",
    "object_version": "string",
    "derived": "string",
    "derived_bytes": "int64",
    "derived_changed_ns": "int64",
    "error": "string",
    "start_utc": "time",
    "end_utc": "time",
    "duration_s": "float64",
    "cameras": {
        "camera": "string",
        "images": "int64",
        "rate_hz": "float64",
        "gaps": "int64",
        "longest_gap_s": "float64",
        "calibrated": "bool",
    },
    "measurements": "int64",
    "events": {"kind": "string", "camera": "string", "count": "int64"},
    "runs": {
        "run": "string",
        "stage": "string",
        "method": "string",
        "version": "int32",
        "state": "string",
        "out_of_date": "bool",
        "ipsys": "string",
    },
    "outdated_runs": "list<string>",
    "models": "list<string>",
    "evaluations": {
        "run": "string",
        "model": "string",
        "camera": "string",
        "scheme": "string",
        "against": "string",
        "dimensions": "string",
        "count": "int64",
        "mean_m": "float64",
        "p95_m": "float64",
        "max_m": "float64",
    },
    "drift": {
        "camera": "string",
        "mean_shift_m": "float64",
        "sigma_m": "float64",
        "moved": "bool",
    },
    "drift_error": "string",
}


@dataclass(frozen=True, slots=True)
class Baseline:
    """The log before all moves of cameras, and the log with the fitted model of the cameras."""

    log: LogLocation
    model_from: LogLocation


def read_row(
    path: LogLocation,
    name: str,
    columns: Mapping[str, Any],
    baseline: Baseline | None,
    derived: Path | None = None,
) -> dict[str, Any]:
    """Return the row of a log; the row of a log that cannot be read has its error instead of contents.

    Parameters
    ----------
    name : of the log in the catalogue.
    columns : those of :func:`state_columns` before the log is read, so that a later change is noticed.
    baseline : for the drift of the cameras since then; None: no drift.
    derived : the derived log of the log, which is read, too; None: there is none.
    """
    row: dict[str, Any] = {"log": name, **columns}
    logs = [path] if derived is None else [path, derived]
    try:
        if derived is not None:
            check_source([path], derived)
        with Session(logs) as session:
            row |= _contents(session)
    except IpsysError as error:
        return row | {"error": reason_without(path, error).partition("\n")[0]}
    except OSError as error:
        return row | {"error": os_error_text(error).removeprefix(f"{path}: ")}
    return row | (_drift(path, baseline) if baseline is not None else {})


def state_columns(state: LogState | None, derived: Path | None = None) -> dict[str, Any]:
    """Return the columns that show a change of a log: a log with the same ones is not read again.

    Parameters
    ----------
    state : of the log; None: there is no such file.
    derived : the derived log of the log; None: there is none.
    """
    of_derived = None if derived is None else read_log_state(derived)
    return {
        "bytes": None if state is None else state.size,
        "changed_ns": None if state is None else state.changed_ns,
        "object_version": None if state is None else state.version or None,
        "derived": None if derived is None else escape_surrogates(str(derived)),
        "derived_bytes": None if of_derived is None else of_derived.size,
        "derived_changed_ns": None if of_derived is None else of_derived.changed_ns,
    }


def _contents(session: Session) -> dict[str, Any]:
    is_empty = not any(reader.message_count for reader in session.readers)
    start_ns, end_ns = session.start_ns, session.end_ns
    evaluations = [*_evaluations(session)]
    times = {} if is_empty else {"start_utc": start_ns, "end_utc": end_ns}
    return {
        **times,
        "duration_s": (end_ns - start_ns) / NS_PER_S,
        "cameras": [*_cameras(session)],
        "measurements": sum(session.count(topic) for topic in session.topics(MEASUREMENTS)),
        "events": [*_events(session)],
        "runs": [*_runs(session)],
        "outdated_runs": outdated_runs(session),
        "models": list(dict.fromkeys(row["model"] for row in evaluations)),
        "evaluations": evaluations,
    }


def _cameras(session: Session) -> Iterator[dict[str, Any]]:
    for camera, topic in sorted(session.images.items()):
        (reader,) = (reader for reader in session.readers if topic in reader.channels)
        gaps = find_gaps(reader.times(topic))
        yield {
            "camera": camera,
            "images": session.count(topic),
            "rate_hz": gaps.rate_hz,
            "gaps": len(gaps.lengths_s),
            "longest_gap_s": max(gaps.lengths_s, default=None),
            "calibrated": camera in session.calibrations,
        }


def _events(session: Session) -> Iterator[dict[str, Any]]:
    counts = Counter((event.kind, event.camera) for event in session.payloads(session.topics(EVENTS)))
    for (kind, camera), count in sorted(counts.items(), key=lambda item: (item[0][0], item[0][1] or "")):
        yield {"kind": kind, "camera": camera, "count": count}


def _runs(session: Session) -> Iterator[dict[str, Any]]:
    for recorded in recorded_stages(session):
        yield {
            "run": recorded.run.run,
            "stage": recorded.run.stage,
            "method": recorded.method or None,
            "version": recorded.stage_version,
            "state": recorded.state,
            "out_of_date": recorded.out_of_date,
            "ipsys": recorded.run.fingerprint.get("ipsys_log"),
        }


def _evaluations(session: Session) -> Iterator[dict[str, Any]]:
    """Yield the errors of each evaluated model: a row for each camera ("" for all), scheme and dimension."""
    kept = ("camera", "scheme", "against", "dimensions", "count", "mean_m", "p95_m", "max_m")
    for run in sorted(session.run_names()):
        for evaluation in session.payloads(session.topics(EVALUATION, run)):
            for row in ModelEvaluation(evaluation.model, run, evaluation).rows():
                yield {"run": run, "model": evaluation.model, **{name: row[name] for name in kept}}


def _drift(path: LogLocation, baseline: Baseline) -> dict[str, Any]:
    """Return the shift of each camera's floor map since the baseline, at the end of the log."""
    from ipsys_log.live_runs.survey.drift_reading import read_drift

    try:
        reading = read_drift([path], baseline.log, baseline.model_from)
    except IpsysError as error:
        return {"drift_error": reason_without(path, error).partition("\n")[0]}
    name = reading.names[-1]
    rows = []
    for camera in sorted(reading.drift.baselines):
        motions = [
            state.motion for state in reading.drift.of_camera(camera) if state.log == name and state.motion
        ]
        if motions:
            last = motions[-1]
            rows.append(
                {
                    "camera": camera,
                    "mean_shift_m": last.mean_shift_m,
                    "sigma_m": last.sigma_m,
                    "moved": last.is_moved,
                }
            )
    return {"drift": rows}


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
    logs = {
        name: (log, state)
        for name, (log, state) in logs.items()
        if not (isinstance(log, Path) and log.resolve() in own)
    }
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
