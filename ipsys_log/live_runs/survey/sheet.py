"""Sheets of tape measurements (CSV): their reader, and their append to a log. See docs/measuring.md."""

import csv
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from ipsys_log.engine.request import Request
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.row_files import find_delimiter, with_decimal_point
from ipsys_log.live_runs.survey.blunders import MODEL_NAME
from ipsys_log.live_runs.survey.checks import EntryCheck, check_entry
from ipsys_log.live_runs.survey.entry import Entry, Fault, TypedEntry, parse_entry
from ipsys_log.live_runs.survey.from_log import FinishedLog, rigs_of
from ipsys_log.live_runs.survey.scene import (
    OTHER_ROWS,
    MarkerObservations,
    StationaryInterval,
    fit_neighbours,
    observe_marker,
)
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Measurement, Model, Rig
from ipsys_log.units import NS_PER_S

_PLAIN = ("id", "marker", "side", "height_cm", "place", "time", "split", "note")
_NEEDED = ("marker", "height_cm")
_LARGEST = 4 << 20
_MOST_DIGITS = 10
_NUMBER = re.compile(r"[\d.]+")
# A time read from a watch may be this far outside of the stationary interval.
_NEAR_NS = 2 * NS_PER_S


@dataclass(frozen=True, slots=True)
class SheetRow:
    """One row of a sheet: its line, its texts, and its stationary interval.

    ``place`` is the number of the interval in the log, or ``time_ns`` is a time within it. Without both, it
    is the next stationary interval of the marker.
    """

    line: int
    typed: TypedEntry
    place: int | None = None
    time_ns: int | None = None


def read_sheet(path: Path, rig: Rig, start_ns: int) -> list[SheetRow]:
    """Read the rows of a sheet.

    Parameters
    ----------
    path : path of the sheet: UTF-8, cells separated by commas, or by semicolons. With semicolons, decimal
        commas are valid too.
    rig : its reference points name the columns ``d_A_cm``, ``d_B_cm`` ...
    start_ns : start of the log; a plain number as ``time`` is in seconds after it.

    Raises
    ------
    IpsysError
        The sheet cannot be read, a column is missing, unknown or repeated, or rows are invalid; the text
        names each bad row by its line.
    """
    lines = _read_lines(path)
    delimiter = find_delimiter(lines[0] if lines else "")
    reader = csv.reader(lines, delimiter=delimiter)
    rows, faults = [], []
    try:
        columns = [name.strip() for name in next(reader, [])]
        _check_columns(columns, rig, path)
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) > len(columns):
                reason = (
                    f"the row has {len(cells)} cells, but the header has "
                    f"{len(columns)}{_comma_advice(delimiter)}"
                )
                faults.append((reader.line_num, reason))
                continue
            cell = dict(zip(columns, (text.strip() for text in cells), strict=False))
            if _NUMBER.fullmatch(cell.get("side", "")):
                reason = f"side {cell['side']!r}: write left or right{_comma_advice(delimiter)}"
                faults.append((reader.line_num, reason))
                continue
            try:
                rows.append(_row(reader.line_num, cell, start_ns))
            except IpsysError as error:
                faults.append((reader.line_num, str(error)))
    except csv.Error as error:
        raise IpsysError(f"{path}: line {reader.line_num}: {error}") from error
    for row in rows:
        checked = check_entry(*parse_entry(row.typed, rig), rig, None, ())
        faults += [(row.line, name_columns(fault.text, rig)) for fault in checked.faults]
    raise_for_rows(path, faults)
    if not rows:
        raise IpsysError(f"{path}: has no measurements below its header; add rows")
    return rows


def _comma_advice(delimiter: str) -> str:
    """Return a hint that a decimal comma may have split a cell."""
    return "; if it has a decimal comma, write a point: 212.7" if delimiter == "," else ""


def raise_for_rows(
    path: Path, faults: Sequence[tuple[int, str]], doubts: Sequence[tuple[int, str]] = ()
) -> None:
    """Raise an error if there are bad rows or rows that look wrong."""
    if faults or doubts:
        lines = "".join(f"\n  line {line}: {text}" for line, text in sorted([*faults, *doubts]))
        force_advice = "" if faults else ", or write it unchanged with --force"
        raise IpsysError(f"{path}: nothing was written; correct the sheet{force_advice}:{lines}")


def name_columns(text: str, rig: Rig) -> str:
    """Return a remark on a point, with the column names of a sheet for its distances.

    Examples
    --------
    >>> from ipsys_log.messages import ReferencePoint
    >>> points = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0))
    >>> name_columns("the distances to A and B look exchanged", Rig("lab", "", 0.2, reference_points=points))
    'd_A_cm and d_B_cm look exchanged'
    """
    names_pattern = "|".join(re.escape(point.name) for point in rig.reference_points)
    name_pattern = re.compile(rf"\b({names_pattern})\b(?=, | and |$)")
    text = re.sub(
        rf"\bthe distances to ((?:(?:{names_pattern}), )*(?:{names_pattern}) and (?:{names_pattern}))\b",
        lambda names: name_pattern.sub(r"d_\1_cm", names[1]),
        text,
    )
    text = re.sub(rf"\b(?:the )?distance to ({names_pattern})\b", r"d_\1_cm", text)
    return re.sub(r"\b(?:the )?height(?=:|\?| reads| and)", "height_cm", text)


def assign_intervals(
    rows: Sequence[SheetRow], intervals: Sequence[StationaryInterval], markers: Sequence[int | None]
) -> Iterator[int | str]:
    """Yield the stationary interval of each row, as index of ``intervals``, or the reason if there is none.

    The ``place`` of a row decides, else its ``time``. Without both, the number of such rows of a marker must
    equal the number of its stationary intervals. Then the rows are assigned in order.
    """
    in_order: dict[int, list[int]] = {}
    for row, marker_id in zip(rows, markers, strict=True):
        if marker_id is not None and row.place is None and row.time_ns is None:
            in_order.setdefault(marker_id, []).append(row.line)
    for row, marker_id in zip(rows, markers, strict=True):
        if marker_id is None:
            yield ""
            continue
        own = [n for n, interval in enumerate(intervals) if interval.marker_id == marker_id]
        if not own:
            seen = ", ".join(map(str, sorted({interval.marker_id for interval in intervals}))) or "none"
            yield f"marker {marker_id} is never stationary in view of a camera (stationary markers: {seen})"
        elif row.place is not None:
            yield _numbered(row.place, marker_id, intervals)
        elif row.time_ns is not None:
            yield _timed(row.time_ns, marker_id, intervals)
        elif len(own) != len(in_order[marker_id]):
            yield (
                f"marker {marker_id} has {len(own)} stationary intervals, but {len(in_order[marker_id])} "
                "rows without place and time: fill in place with the numbers of ipsys measure LOG --places"
            )
        else:
            yield own[in_order[marker_id].index(row.line)]


def _numbered(place: int, marker_id: int, intervals: Sequence[StationaryInterval]) -> int | str:
    if not 1 <= place <= len(intervals):
        return f"place {place} is not between 1 and {len(intervals)}"
    other = intervals[place - 1].marker_id
    return place - 1 if other == marker_id else f"place {place} is of marker {other}, not {marker_id}"


def _timed(time_ns: int, marker_id: int, intervals: Sequence[StationaryInterval]) -> int | str:
    def away_ns(number: int) -> int:
        return max(intervals[number].start_ns - time_ns, time_ns - intervals[number].end_ns, 0)

    nearest = min((n for n, interval in enumerate(intervals) if interval.marker_id == marker_id), key=away_ns)
    if away_ns(nearest) > _NEAR_NS:
        return (
            f"marker {marker_id} is not stationary at this time; its nearest interval is place {nearest + 1}"
        )
    return nearest


def _read_lines(path: Path) -> list[str]:
    try:
        if path.stat().st_size > _LARGEST:
            raise IpsysError(f"{path}: is too large for a sheet of measurements; give another file")
        return path.read_text(encoding="utf-8-sig").splitlines(keepends=True)
    except OSError as error:
        raise IpsysError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise IpsysError(f"{path}: is not a text file; save the sheet as CSV, in UTF-8") from error


def _check_columns(columns: Sequence[str], rig: Rig, path: Path) -> None:
    distances = [f"d_{point.name}_cm" for point in rig.reference_points]
    valid = [*_PLAIN[:2], *distances, *_PLAIN[2:]]
    for name in columns:
        if name not in valid:
            raise IpsysError(f"{path}: line 1: unknown column {name!r}; known are {', '.join(valid)}")
        if columns.count(name) > 1:
            raise IpsysError(f"{path}: line 1: two columns have the name {name!r}")
    missing = [name for name in _NEEDED if name not in columns]
    if len(set(distances) & set(columns)) < 2:
        missing += distances[:2]
    if missing:
        raise IpsysError(f"{path}: line 1: the column {missing[0]} is missing; known are {', '.join(valid)}")


def _row(line: int, cell: dict[str, str], start_ns: int) -> SheetRow:
    distances = {n[2:-3]: text for n, text in cell.items() if n.startswith("d_") and n.endswith("_cm")}
    typed = TypedEntry(
        cell.get("marker", ""),
        distances,
        cell.get("side", ""),
        cell.get("height_cm", ""),
        cell.get("split", ""),
        cell.get("id", ""),
    )
    place, time = cell.get("place", ""), cell.get("time", "")
    if place and not (place.isascii() and place.isdecimal() and len(place) < _MOST_DIGITS):
        raise IpsysError(
            f"place {place[:_MOST_DIGITS]!r} is not a whole number; give the number of a stationary interval"
        )
    return SheetRow(line, typed, int(place) if place else None, _time_ns(time, start_ns) if time else None)


def _time_ns(text: str, start_ns: int) -> int:
    """Parse seconds from the start of the log, or a date and time (UTC if it has no time zone)."""
    try:
        seconds = float(with_decimal_point(text))
        if math.isfinite(seconds) and abs(seconds) < 1e9:
            return start_ns + round(seconds * NS_PER_S)
    except ValueError:
        pass
    try:
        moment = datetime.fromisoformat(text)
        moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
        return int((moment - datetime.fromtimestamp(0, UTC)).total_seconds() * 1e6) * 1000
    except (ValueError, OverflowError):
        raise IpsysError(
            f"time {text!r} is not valid; write seconds from the start of the log, or 2026-05-04 10:15:30"
        ) from None


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """A row of a sheet, its entry, and the observations of its marker.

    ``fault`` is the reason if the row has no stationary interval in the log, else empty.
    """

    line: int
    entry: Entry
    faults: Sequence[Fault]
    fault: str
    observations: MarkerObservations | None


def check_sheet(path: Path, log: Path, request: Request) -> None:
    """Check that a sheet can be read, before the long processing of a log begins."""
    with Session([log]) as session:
        rigs = rigs_of(session, request)
        if rigs:
            read_sheet(path, rigs[-1], session.start_ns)


def add_sheet(scene: FinishedLog, path: Path, force: bool = False) -> list[str]:
    """Append the measurements of a sheet: all of them, or none; with ``force``, also rows that look wrong.

    Returns
    -------
    Remarks on uncertain points, and on rows that look wrong but were written, by line.

    Raises
    ------
    IpsysError
        Rows are bad; the text names each row by its line, with the contradiction.
    """
    rows = list(_sighted(scene, read_sheet(path, scene.rig, scene.start_ns)))
    model, name = scene.model, MODEL_NAME
    checked = _check(scene, rows, model, name)
    if model is None:  # then the rows are compared with each other
        model, name = _fit(scene, rows, checked), OTHER_ROWS
        checked = checked if model is None else _check(scene, rows, model, name)
    faults = [(row.line, row.fault) for row in rows if row.fault]
    faults += _by_line(rows, [[fault.text for fault in result.faults] for result in checked], scene.rig)
    doubts = _by_line(rows, _contradictions(rows, checked, scene, model), scene.rig)
    raise_for_rows(path, faults, () if force else doubts)
    scene.add([result.measurement for result in checked if result.measurement is not None])
    ids = {row.line: result.id for row, result in zip(rows, checked, strict=True)}
    imprecise = _by_line(rows, [result.imprecise for result in checked], scene.rig)
    return [f"line {line}: {ids[line]}: {text}" for line, text in sorted(doubts + imprecise)]


def _by_line(rows: Sequence[_Row], texts: Sequence[Sequence[str]], rig: Rig) -> list[tuple[int, str]]:
    """Name the columns of a sheet in remarks on its rows."""
    return [
        (row.line, name_columns(text, rig))
        for row, row_texts in zip(rows, texts, strict=True)
        for text in row_texts
    ]


def _sighted(scene: FinishedLog, rows: Sequence[SheetRow]) -> Iterator[_Row]:
    """Find the stationary interval of each row, and the observations of its marker in this interval."""
    parsed = [parse_entry(row.typed, scene.rig) for row in rows]
    intervals = assign_intervals(rows, scene.intervals, [entry.marker_id for entry, _ in parsed])
    for row, (entry, faults), interval in zip(rows, parsed, intervals, strict=True):
        observations = None
        if isinstance(interval, int) and entry.marker_id is not None:
            observations = observe_marker(scene.views(interval), entry.marker_id)
        yield _Row(row.line, entry, faults, interval if isinstance(interval, str) else "", observations)


def _check(scene: FinishedLog, rows: Sequence[_Row], model: Model | None, name: str) -> list[EntryCheck]:
    """Check each row as the web page does, after the rows above it."""
    history, results = [*scene.history()], []
    for row in rows:
        result = check_entry(row.entry, row.faults, scene.rig, row.observations, history, model, name)
        history += [] if result.measurement is None else [result.measurement]
        results.append(result)
    return results


def _fit(scene: FinishedLog, rows: Sequence[_Row], checked: Sequence[EntryCheck]) -> Model | None:
    """Fit a model to the rows themselves, without the rows that contradict it."""
    seen: list[tuple[Measurement, MarkerObservations]] = []
    for row, result in zip(rows, checked, strict=True):
        if result.measurement is not None and row.observations is not None:
            seen.append((result.measurement, row.observations))
    return fit_neighbours(seen, scene.rig)


def _contradictions(
    rows: Sequence[_Row], checked: Sequence[EntryCheck], scene: FinishedLog, model: Model | None
) -> list[list[str]]:
    """Return the contradictions of each row; a hint names another contradictory row that the numbers fit."""
    doubtful = [row for row, result in zip(rows, checked, strict=True) if result.contradictions]
    doubts = []
    for row, result in zip(rows, checked, strict=True):
        other = next((r for r in doubtful if result.contradictions and _fits(row, r, scene, model)), None)
        hint = (
            "" if other is None else f"; its numbers fit line {other.line} (marker {other.entry.marker_id})"
        )
        doubts.append([text + hint for text in result.contradictions])
    return doubts


def _fits(row: _Row, other: _Row, scene: FinishedLog, model: Model | None) -> bool:
    """Return True if the numbers of a row fit the observations of another row."""
    if other is row or other.observations is None:
        return False
    entry = replace(row.entry, marker_id=other.entry.marker_id, id=None)
    result = check_entry(entry, (), scene.rig, other.observations, (), model)
    return bool(result.predictions) and result.measurement is not None and not result.contradictions
