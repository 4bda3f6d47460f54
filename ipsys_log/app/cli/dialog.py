"""Entry of calibration points in the terminal: one question after the other, each answer checked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import typer

from ipsys_log.app.cli.console import console
from ipsys_log.errors import IpsysError
from ipsys_log.units import CM_PER_M

if TYPE_CHECKING:
    from ipsys_log.live_runs.survey.checks import EntryCheck
    from ipsys_log.live_runs.survey.entry import Entry, Fault, TypedEntry
    from ipsys_log.live_runs.survey.scene import MeasuringScene
    from ipsys_log.messages import Measurement, Rig

    # Reads an answer: returns its content and its faults.
    Read = Callable[[str], tuple[Entry, list[Fault]]]

HELP = (
    "type centimetres, such as 123.4; a: start the point again, s: skip it, u: undo the last point, q: end; "
    "Enter keeps the value in brackets"
)
_LETTERS = ("a", "s", "u", "q")
_SIDES = {**dict.fromkeys(("l", "left", "links"), "left"), **dict.fromkeys(("r", "right", "rechts"), "right")}
_YES_NO = {"y": True, "yes": True, "n": False, "no": False}


class LetterError(Exception):
    """A letter typed instead of an answer; it is ``q`` if the terminal was closed."""


def answer(question: str, usual: str = "") -> str:
    """Return the typed answer, or ``usual`` for an empty answer.

    Raises
    ------
    LetterError
        The answer is a letter with a meaning at any question.
    """
    try:
        text = str(typer.prompt(question, default=usual, show_default=bool(usual))).strip()
    except (typer.Abort, EOFError):
        raise LetterError("q") from None
    if text.lower() in _LETTERS:
        raise LetterError(text.lower())
    return text


def agreed(question: str, usual: bool) -> bool:
    """Ask for yes or no until the answer is valid; return whether it is yes."""
    while True:
        text = answer(f"{question} [{'Y/n' if usual else 'y/N'}]").lower()
        if not text or text in _YES_NO:
            return _YES_NO.get(text, usual)
        _complain([f"{text!r} is not yes or no; type y or n"])


def ask_marker(rig: Rig, usual: str) -> str:
    """Ask for a marker until the answer is a marker of the rig."""
    from ipsys_log.live_runs.survey.entry import TypedEntry, parse_entry

    return _ask("marker", "marker", usual, lambda given: parse_entry(TypedEntry(given, {}), rig))


def ask_numbers(rig: Rig, marker: str, before: TypedEntry | None) -> TypedEntry:
    """Ask for distances, side and height of a calibration point; Enter keeps the previous text."""
    from ipsys_log.live_runs.survey.entry import TypedEntry, needs_side, parse_entry

    distances = _ask_distances(rig, dict(before.distances) if before else {})
    entered = [name for name, text in distances.items() if text]
    side = ""
    if needs_side(rig, entered):
        usual = before.side if before else ""
        question = (
            f"side of the line from {entered[0]} to {entered[1]}, left or right?{'' if usual else ' [l/r]'}"
        )
        side = _ask_side(question, usual)
    usual = before.height if before else ""
    height = _ask(
        "height, cm", "height", usual, lambda text: parse_entry(TypedEntry("", {}, height=text), rig)
    )
    return TypedEntry(marker, distances, side, height)


def _ask_distances(rig: Rig, distances: dict[str, str]) -> dict[str, str]:
    """Ask for distances until they are consistent with one calibration point; 0 is on a reference point."""
    from ipsys_log.live_runs.survey.checks import check_entry
    from ipsys_log.live_runs.survey.entry import TypedEntry, parse_entry
    from ipsys_log.statistics.tape import is_on_reference

    def of(name: str) -> Read:
        return lambda given: parse_entry(TypedEntry("", {name: given}), rig)

    while True:
        for name in (point.name for point in rig.reference_points):
            distances[name] = _ask(f"distance to {name}, cm", f"d_{name}", distances.get(name, ""), of(name))
            entry, _ = of(name)(distances[name])
            if is_on_reference(entry.distances):
                return {name: distances[name]}
        together = check_entry(*parse_entry(TypedEntry("", distances), rig), rig, None, ())
        faults = [fault.text for fault in together.faults if not fault.field]
        if not faults:
            return distances
        _complain(faults)


def _ask_side(question: str, usual: str) -> str:
    while True:
        typed = answer(question, usual)
        if typed.lower() in _SIDES:
            return _SIDES[typed.lower()]
        _complain([f"{typed!r} is not a side; type l or r" if typed else "type l or r"])


def _ask(question: str, field: str, usual: str, read: Read) -> str:
    """Ask until an answer is valid for a field; ask once more if the answer is doubtful."""
    while True:
        typed = answer(question, usual)
        entry, faults = read(typed)
        wrong = [fault.text for fault in faults if fault.field == field]
        if wrong:
            _complain(wrong)
        elif entry.doubts and typed != usual:
            _complain(entry.doubts, "yellow")
            usual = typed
        else:
            return typed


def _complain(texts: Sequence[str], style: str = "red") -> None:
    for text in texts:
        console.print(text, style=style)


def ask_places(scene: MeasuringScene) -> None:
    """Go through the stationary intervals that are not measured yet; with live cameras, ask until ``q``."""
    from ipsys_log.live_runs.survey.entry import check_references
    from ipsys_log.statistics.calibration_points import active_measurements

    check_references(scene.rig)
    with suppress(ImportError):  # arrow keys, if the system has readline
        import readline  # noqa: F401
    console.print(HELP, style="dim")
    _ask_baseline(scene)
    active = active_measurements(scene.history())
    saved: list[str] = []
    left: list[int | None] = [
        n for n, interval in enumerate(scene.intervals) if not any(map(interval.covers, active))
    ]
    if not scene.intervals:
        left = [None]
    while left:
        outcome = _ask_place(scene, left[0], saved)
        if outcome == "q":
            return
        if not isinstance(outcome, str):  # it was undone: ask for its stationary interval again
            left[:0] = [
                n for n, interval in enumerate(scene.intervals) if interval.covers(outcome) and n not in left
            ]
        elif scene.intervals:
            del left[0]
    console.print("all stationary intervals are done")


def _ask_baseline(scene: MeasuringScene) -> None:
    """Ask once for the distance AB with this tape, where it counts; Enter or a letter skips it."""
    from ipsys_log.live_runs.survey.checks import baseline_names, needs_baseline, read_baseline

    while needs_baseline(scene.rig, scene.history()):
        first, second = baseline_names(scene.rig)
        try:
            typed = answer(f"distance from {first} to {second} with this tape, cm [Enter: skip]")
        except LetterError:
            return
        if not typed:
            return
        time_ns = max((view.time_ns for view in scene.views(None)), default=0)
        try:
            scene.add([read_baseline(typed, scene.rig, scene.history(), time_ns)])
        except IpsysError as error:
            _complain([str(error)])


def _ask_place(scene: MeasuringScene, interval: int | None, saved: list[str]) -> str | Measurement:
    """Ask until a point is measured or skipped; return ``s``, ``q`` to end, or the undone measurement.

    ``saved`` has the ids that this session has measured, the newest last.
    """
    typed: TypedEntry | None = None
    while True:
        try:
            typed = _measure(scene, interval, typed, saved)
            if typed is None:
                return "s"
        except LetterError as left:
            letter = str(left)
            if letter in ("q", "s"):
                return letter
            if letter == "a":
                typed = None
            else:
                undone = _undo(scene, saved)
                if undone is not None:
                    return undone


def _measure(
    scene: MeasuringScene, interval: int | None, before: TypedEntry | None, saved: list[str]
) -> TypedEntry | None:
    """Ask for one point and append it; return the typed texts if the point must be asked for again."""
    typed = _ask_point(scene, interval, before)
    while True:
        checked = _check(scene, interval, typed)
        _show(checked)
        if checked.faults and interval is None and {fault.field for fault in checked.faults} == {"marker"}:
            answer("press Enter to check again")
            continue
        if checked.measurement is None:
            return typed
        doubtful = bool(checked.warnings)
        if not agreed(f"save {checked.id}{' anyway' if doubtful else ''}?", not doubtful):
            return typed
        # The marker may have stopped or moved while the user read the question.
        now = _check(scene, interval, typed)
        if now.measurement is None:
            continue
        try:
            scene.add([now.measurement])
        except IpsysError as error:
            console.print(str(error), style="red")
            continue
        saved.append(now.id)
        console.print(f"{now.id} is in the log", style="green")
        return None


def _check(scene: MeasuringScene, interval: int | None, typed: TypedEntry) -> EntryCheck:
    from ipsys_log.live_runs.survey.checks import check_entry
    from ipsys_log.live_runs.survey.entry import parse_entry
    from ipsys_log.live_runs.survey.scene import observe_marker

    entry, faults = parse_entry(typed, scene.rig)
    observations = None if entry.marker_id is None else observe_marker(scene.views(interval), entry.marker_id)
    return check_entry(entry, faults, scene.rig, observations, scene.history(), scene.model)


def _ask_point(scene: MeasuringScene, interval: int | None, before: TypedEntry | None) -> TypedEntry:
    from ipsys_log.live_runs.survey.scene import observe_marker, visible_markers

    console.print()
    if interval is None:
        visible = visible_markers(scene.views(None), scene.rig)
        console.print(f"visible markers: {', '.join(map(str, visible)) or 'none'}")
        usual = before.marker if before else str(visible[0]) if len(visible) == 1 else ""
        marker = ask_marker(scene.rig, usual)
    else:
        stationary = scene.intervals[interval]
        marker = str(stationary.marker_id)
        console.print(f"Stationary interval {interval + 1} of {len(scene.intervals)}", style="bold")
    observations = observe_marker(scene.views(interval), int(marker))
    console.print(observations.text, style="green" if observations.state == "still" else "yellow")
    return ask_numbers(scene.rig, marker, before)


def _show(checked: EntryCheck) -> None:
    for fault in checked.faults:
        console.print(fault.text, style="red")
    if checked.point_m is not None:
        x_m, y_m, z_m = checked.point_m.tolist()
        known = "" if checked.sigma_m is None else f" +- {checked.sigma_m * CM_PER_M:.1f} cm"
        where = "" if checked.on_floor is None else ", on the floor area" if checked.on_floor else ""
        x_cm, y_cm, z_cm = x_m * CM_PER_M, y_m * CM_PER_M, z_m * CM_PER_M
        console.print(f"x {x_cm:.1f} cm, y {y_cm:.1f} cm{known}, height {z_cm:.1f} cm{where}")
    for name, off_m in checked.residuals_m:
        console.print(f"  residual of the distance to {name}: {off_m * CM_PER_M:+.1f} cm")
    for prediction in checked.predictions:
        off_cm = prediction.off_m * CM_PER_M
        console.print(f"  distance to the prediction of {prediction.camera}: {off_cm:.1f} cm")
    for text in checked.warnings:
        console.print(text, style="yellow")


def _undo(scene: MeasuringScene, saved: list[str]) -> Measurement | None:
    """Withdraw the last valid measurement, and return it; None if none is withdrawn.

    A measurement of an earlier session is withdrawn only if the user agrees.
    """
    from ipsys_log.live_runs.survey.checks import withdrawal_of
    from ipsys_log.statistics.calibration_points import active_measurements

    active = {measurement.id: measurement for measurement in active_measurements(scene.history())}
    if not active:
        console.print("the log has no measurements yet", style="yellow")
        return None
    own = [name for name in saved if name in active]
    last = active[own[-1]] if own else list(active.values())[-1]
    if not own and not _agreed_to_withdraw(last):
        console.print("no measurement is withdrawn", style="yellow")
        return None
    try:
        scene.add([withdrawal_of(scene.history(), last.id)])
    except IpsysError as error:
        console.print(str(error), style="red")
        return None
    console.print(f"{last.id} is withdrawn", style="green")
    return last


def _agreed_to_withdraw(measurement: Measurement) -> bool:
    """Ask before a measurement of an earlier session is withdrawn; a letter means no."""
    tapes = ", ".join(f"{tape.reference} {tape.distance_m * CM_PER_M:.1f}" for tape in measurement.distances)
    text = f"{measurement.id} (marker {measurement.marker_id}{': ' if tapes else ''}{tapes})"
    try:
        return agreed(f"this session has no measurements; {text} is of an earlier one. Withdraw it?", False)
    except LetterError:
        return False
