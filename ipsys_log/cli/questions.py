"""The questions of a place in the terminal: each answer is checked at once, only a bad one asked anew."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import typer

from ipsys_log.cli.console import console

if TYPE_CHECKING:
    from ipsys_log.messages import Rig
    from ipsys_log.survey.entry import Entry, Fault, Typed

    # Of an answer: what it says, and what is wrong.
    Read = Callable[[str], tuple[Entry, list[Fault]]]

__all__ = ["HELP", "LetterError", "agreed", "answer", "ask_marker", "ask_numbers"]

HELP = (
    "centimetres, such as 123.4; a begins the place anew, s skips it, u undoes the last one, q ends; Enter "
    "keeps what stands in brackets"
)
_LETTERS = ("a", "s", "u", "q")
_SIDES = {**dict.fromkeys(("l", "left", "links"), "left"), **dict.fromkeys(("r", "right", "rechts"), "right")}
_YES_NO = {"y": True, "yes": True, "n": False, "no": False}


class LetterError(Exception):
    """A letter was typed instead of an answer; or the terminal has gone, which is ``q``."""


def answer(question: str, usual: str = "") -> str:
    """What is typed; what is usual where nothing is.

    Raises
    ------
    LetterError
        For a letter that means something at any question.
    """
    try:
        given = str(typer.prompt(question, default=usual, show_default=bool(usual))).strip()
    except (typer.Abort, EOFError):
        raise LetterError("q") from None
    if given.lower() in _LETTERS:
        raise LetterError(given.lower())
    return given


def agreed(question: str, usual: bool) -> bool:
    """Ask for yes or no until it is one of them."""
    while True:
        given = answer(f"{question} [{'Y/n' if usual else 'y/N'}]").lower()
        if not given or given in _YES_NO:
            return _YES_NO.get(given, usual)
        _complain([f"{given!r} is neither yes nor no; type y or n"])


def ask_marker(rig: Rig, usual: str) -> str:
    """Ask for a marker until it is one of the rig."""
    from ipsys_log.survey.entry import Typed, read_typed

    return _ask("marker", "marker", usual, lambda given: read_typed(Typed(given, {}), rig))


def ask_numbers(rig: Rig, marker: str, before: Typed | None) -> Typed:
    """Ask for distances, side and height of a place; Enter keeps what was typed before."""
    from ipsys_log.survey.entry import Typed, needs_side, read_typed

    distances = _ask_distances(rig, dict(before.distances) if before else {})
    given = [name for name, text in distances.items() if text]
    side = ""
    if needs_side(rig, given):
        usual = before.side if before else ""
        question = f"from {given[0]} to {given[1]}, it lies left or right?{'' if usual else ' [l/r]'}"
        side = _ask_side(question, usual)
    usual = before.height if before else ""
    height = _ask("height, cm", "height", usual, lambda text: read_typed(Typed("", {}, height=text), rig))
    return Typed(marker, distances, side, height)


def _ask_distances(rig: Rig, distances: dict[str, str]) -> dict[str, str]:
    """Ask until they can be those of one place, as far as distances alone tell."""
    from ipsys_log.survey.checks import check_entry
    from ipsys_log.survey.entry import Typed, read_typed

    def of(name: str) -> Read:
        return lambda given: read_typed(Typed("", {name: given}), rig)

    while True:
        for name in (point.name for point in rig.reference_points):
            distances[name] = _ask(f"distance to {name}, cm", f"d_{name}", distances.get(name, ""), of(name))
        together = check_entry(*read_typed(Typed("", distances), rig), rig, None, ())
        faults = [fault.text for fault in together.faults if not fault.field]
        if not faults:
            return distances
        _complain(faults)


def _ask_side(question: str, usual: str) -> str:
    while True:
        given = answer(question, usual)
        if given.lower() in _SIDES:
            return _SIDES[given.lower()]
        _complain([f"{given!r} is no side; type l or r" if given else "type l or r"])


def _ask(question: str, field: str, usual: str, read: Read) -> str:
    """Ask until an answer can be one of a field; what is doubtful once more."""
    while True:
        given = answer(question, usual)
        entry, faults = read(given)
        wrong = [fault.text for fault in faults if fault.field == field]
        if wrong:
            _complain(wrong)
        elif entry.doubts and given != usual:
            _complain(entry.doubts, "yellow")
            usual = given
        else:
            return given


def _complain(texts: Sequence[str], style: str = "red") -> None:
    for text in texts:
        console.print(text, style=style, markup=False)
