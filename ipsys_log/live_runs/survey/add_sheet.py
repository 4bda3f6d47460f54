"""Append of a sheet of measurements to a finished log: all rows, or none."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ipsys_log.engine.request import Request
from ipsys_log.live_runs.survey.blunders import MODEL_NAME
from ipsys_log.live_runs.survey.checks import EntryCheck, check_entry
from ipsys_log.live_runs.survey.entry import Entry, Fault, parse_entry
from ipsys_log.live_runs.survey.from_log import FinishedLog, rigs_of
from ipsys_log.live_runs.survey.scene import OTHER_ROWS, MarkerObservations, fit_neighbours, observe_marker
from ipsys_log.live_runs.survey.sheet import (
    SheetRow,
    assign_intervals,
    name_columns,
    raise_for_rows,
    read_sheet,
)
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Measurement, Model, Rig


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
    """Check that a sheet can be read, before the long processing of a log begins.

    Raises
    ------
    IpsysError
        See :func:`~ipsys_log.live_runs.survey.sheet.read_sheet`.
    """
    with Session([log]) as session:
        rigs = rigs_of(session, request)
        if rigs:
            read_sheet(path, rigs[-1], session.start_ns)


def add_sheet(scene: FinishedLog, path: Path, force: bool = False) -> list[str]:
    """Append the measurements of a sheet: all of them, or none.

    Parameters
    ----------
    scene : the log.
    path : path of the sheet.
    force : also write rows that look wrong but may be right.

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
