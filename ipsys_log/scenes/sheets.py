"""A sheet of measurements into a finished log: all of its rows, or none."""

from __future__ import annotations

from pathlib import Path

from ipsys_log.log.session import Session
from ipsys_log.measuring.check import check_entry
from ipsys_log.measuring.entry import read_typed
from ipsys_log.measuring.scene import look
from ipsys_log.measuring.sheet import find_stops, name_columns, read_sheet, refuse_rows
from ipsys_log.messages import Measurement
from ipsys_log.runs.request import Request
from ipsys_log.scenes.finished import FinishedLog, rigs_of

__all__ = ["add_sheet", "check_sheet"]


def check_sheet(path: Path, log: Path, request: Request) -> None:
    """See that a sheet can be read, before the long work on a log begins.

    Raises
    ------
    IpsysError
        See :func:`~ipsys_log.measuring.sheet.read_sheet`.
    """
    with Session([log]) as session:
        rigs = rigs_of(session, request)
        if rigs:
            read_sheet(path, rigs[-1], session.start_ns)


def add_sheet(scene: FinishedLog, path: Path) -> list[str]:
    """Append the measurements of a sheet: all of them, or none.

    Returns
    -------
    What to look at again, by line.

    Raises
    ------
    IpsysError
        Naming every bad row by its line.
    """
    rows = read_sheet(path, scene.rig, scene.start_ns)
    read = [read_typed(row.typed, scene.rig) for row in rows]
    found = list(find_stops(rows, scene.stops, [entry.marker_id for entry, _ in read]))
    faults: list[tuple[int, str]] = []
    warnings: list[str] = []
    measurements: list[Measurement] = []
    for row, (entry, wrong), stop in zip(rows, read, found, strict=True):
        if isinstance(stop, str) and stop:
            faults.append((row.line, stop))
        sight = None
        if isinstance(stop, int) and entry.marker_id is not None:
            sight = look(scene.views(stop), entry.marker_id)
        history = [*scene.history(), *measurements]
        checked = check_entry(entry, wrong, scene.rig, sight, history, scene.model)
        faults += [(row.line, name_columns(fault.text, scene.rig)) for fault in checked.faults]
        warnings += [
            f"line {row.line}: {checked.id}: {name_columns(text, scene.rig)}" for text in checked.warnings
        ]
        if checked.measurement is not None:
            measurements.append(checked.measurement)
    refuse_rows(path, faults)
    scene.add(measurements)
    return warnings
