"""Measuring in the terminal: one question after the other."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import typer

from ipsys_log.cli.console import console

if TYPE_CHECKING:
    from ipsys_log.measuring.check import Checked
    from ipsys_log.measuring.entry import Typed
    from ipsys_log.measuring.scene import Scene
    from ipsys_log.messages import Measurement, Rig

__all__ = ["ask_places"]

_HELP = "centimetres, such as 123.4; a begins the place anew, s skips it, u undoes the last one, q ends"
_LETTERS = ("a", "s", "u", "q")


class _LetterError(Exception):
    """A letter was typed instead of a number."""


def ask_places(scene: Scene) -> None:
    """Go through the places that are not measured yet; of a recording, through what is there, until ``q``."""
    from ipsys_log.measuring.entry import check_references
    from ipsys_log.offline.pairs import active_measurements

    check_references(scene.rig)
    console.print(_HELP, style="dim", markup=False)
    active = active_measurements(scene.history())
    left: list[int | None] = [n for n, stop in enumerate(scene.stops) if not any(map(stop.covers, active))]
    if not scene.stops:
        left = [None]
    while left:
        outcome = _ask_place(scene, left[0])
        if outcome == "q":
            return
        if not isinstance(outcome, str):  # it was undone: back to its place
            left[:0] = [n for n, stop in enumerate(scene.stops) if stop.covers(outcome) and n not in left]
        elif scene.stops:
            del left[0]
    console.print("no more places in this log")


def _ask_place(scene: Scene, stop: int | None) -> str | Measurement:
    """Ask until a place is measured or skipped: ``s``, ``q`` to end, or what was undone."""
    while True:
        try:
            if _measure(scene, stop):
                return "s"
        except _LetterError as left:
            letter = str(left)
            if letter in ("q", "s"):
                return letter
            if letter == "u":
                undone = _undo(scene)
                if undone is not None:
                    return undone


def _measure(scene: Scene, stop: int | None) -> bool:
    """Ask for one place and append it; False where it is to be asked for again."""
    from ipsys_log.errors import IpsysError

    typed = _ask(scene, stop)
    while True:
        checked = _check(scene, stop, typed)
        _show(checked)
        if checked.faults and stop is None and {fault.field for fault in checked.faults} == {"marker"}:
            _text("Enter looks again", lambda given: not given)
            continue
        if checked.measurement is None:
            return False
        question, usual = (" all the same? [y/N]", "n") if checked.warnings else ("? [Y/n]", "y")
        answer = _text(f"save {checked.id}{question}", lambda given: given.lower() in ("", "y", "n"))
        if (answer.lower() or usual) == "n":
            return False
        # While somebody read the question, the marker lay there, or was taken up.
        now = _check(scene, stop, typed)
        if now.measurement is None:
            continue
        try:
            scene.add([now.measurement])
        except IpsysError as error:
            console.print(str(error), style="red", markup=False)
            continue
        console.print(f"{now.id} is in the log", style="green", markup=False)
        return True


def _check(scene: Scene, stop: int | None, typed: Typed) -> Checked:
    from ipsys_log.measuring.check import check_entry
    from ipsys_log.measuring.entry import read_typed
    from ipsys_log.measuring.scene import look

    entry, faults = read_typed(typed, scene.rig)
    sight = None if entry.marker_id is None else look(scene.views(stop), entry.marker_id)
    return check_entry(entry, faults, scene.rig, sight, scene.history(), scene.model)


def _ask(scene: Scene, stop: int | None) -> Typed:
    from ipsys_log.measuring.entry import Typed, needs_side
    from ipsys_log.measuring.scene import look, visible_markers

    console.print()
    if stop is None:
        visible = visible_markers(scene.views(None), scene.rig)
        console.print(f"markers seen: {', '.join(map(str, visible)) or 'none'}", markup=False)
        marker = _marker(scene.rig, str(visible[0]) if len(visible) == 1 else "")
    else:
        here = scene.stops[stop]
        marker = str(here.marker_id)
        console.print(f"Place {stop + 1} of {len(scene.stops)}", style="bold")
    sight = look(scene.views(stop), int(marker))
    console.print(sight.text, style="green" if sight.state == "still" else "yellow", markup=False)
    names = [point.name for point in scene.rig.reference_points]
    # Of more than two reference points any two will do.
    may_lack = len(names) > 2
    distances: dict[str, str] = {}
    for name in names:
        question = f"from {name}, cm"
        distances[name] = _number(question, f"d_{name}", may_lack, scene.rig, partial(_of_tape, name))
    given = [name for name in names if distances[name]]
    side = ""
    if needs_side(scene.rig, given):
        question = f"from {given[0]} to {given[1]}, it lies left or right? [l/r]"
        letter = _text(question, lambda answer: answer[:1].lower() in ("l", "r") and answer != "")
        side = "left" if letter[0].lower() == "l" else "right"
    return Typed(marker, distances, side, _number("height, cm", "height", False, scene.rig, _of_ruler))


def _marker(rig: Rig, usual: str) -> str:
    """Ask for a marker until it is one of the rig."""
    from ipsys_log.measuring.entry import Typed, read_typed

    while True:
        answer = _text("marker", str.isdecimal, usual)
        faults = [fault for fault in read_typed(Typed(answer, {}), rig)[1] if fault.field == "marker"]
        if not faults:
            return answer
        console.print(faults[0].text, style="red", markup=False)


def _of_tape(name: str, text: str) -> Typed:
    from ipsys_log.measuring.entry import Typed

    return Typed("", {name: text})


def _of_ruler(text: str) -> Typed:
    from ipsys_log.measuring.entry import Typed

    return Typed("", {}, height=text)


def _number(question: str, field: str, may_lack: bool, rig: Rig, typed: Callable[[str], Typed]) -> str:
    """Ask for a number until it can be one of a field."""
    from ipsys_log.measuring.entry import read_typed

    def fits(answer: str) -> bool:
        return (not answer and may_lack) or answer.replace(",", ".").replace(".", "", 1).isdecimal()

    while True:
        answer = _text(question, fits)
        faults = [fault.text for fault in read_typed(typed(answer), rig)[1] if fault.field == field]
        if not answer or not faults:
            return answer
        console.print(faults[0], style="red", markup=False)


def _text(question: str, fits: Callable[[str], bool], default: str = "") -> str:
    while True:
        try:
            answer = str(typer.prompt(question, default=default, show_default=bool(default))).strip()
        except (typer.Abort, EOFError):
            raise _LetterError("q") from None
        if fits(answer):
            return answer
        if answer.lower() in _LETTERS:
            raise _LetterError(answer.lower())
        console.print(_HELP, style="yellow", markup=False)


def _show(checked: Checked) -> None:
    from ipsys_log.units import CM_PER_M

    for fault in checked.faults:
        console.print(fault.text, style="red", markup=False)
    if checked.point_m is not None:
        x_m, y_m, z_m = checked.point_m.tolist()
        known = "" if checked.sigma_m is None else f" +- {checked.sigma_m * CM_PER_M:.1f} cm"
        where = "" if checked.on_floor is None else ", on the floor" if checked.on_floor else ""
        console.print(
            f"x {x_m:.3f} m, y {y_m:.3f} m{known}, {z_m * CM_PER_M:.1f} cm high{where}", markup=False
        )
    for name, off_m in checked.residuals_m:
        console.print(f"  {name} disagrees by {off_m * CM_PER_M:+.1f} cm", markup=False)
    for one in checked.predictions:
        console.print(f"  model of {one.camera}: {one.off_m * CM_PER_M:.1f} cm off", markup=False)
    for text in checked.warnings:
        console.print(text, style="yellow", markup=False)


def _undo(scene: Scene) -> Measurement | None:
    """Withdraw the last measurement that counts, and return it; None where none is withdrawn."""
    from ipsys_log.errors import IpsysError
    from ipsys_log.measuring.check import withdraw
    from ipsys_log.offline.pairs import active_measurements

    active = active_measurements(scene.history())
    if not active:
        console.print("nothing is measured yet", style="yellow")
        return None
    try:
        scene.add([withdraw(scene.history(), active[-1].id)])
    except IpsysError as error:
        console.print(str(error), style="red", markup=False)
        return None
    console.print(f"{active[-1].id} is withdrawn", style="green", markup=False)
    return active[-1]
