"""Prints of the first day as PDF, at true size: the markers of the lab, and a calibration board."""

from __future__ import annotations

from collections.abc import Mapping

from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.first_day.board_entry import parse_board_entry
from ipsys_log.first_day.lab_folder import LabFolder
from ipsys_log.report.prints import Print, board_print, rig_prints
from ipsys_log.rig.file import load_rig
from ipsys_log.survey.entry import Fault


def print_markers(folder: LabFolder) -> bytes:
    """Return the markers of the rig file as PDF (``ipsys markers --rig lab.toml``).

    Raises
    ------
    IpsysError
        The rig has a fault, or lists no markers. Or Matplotlib is not installed.
    """
    rig = load_rig(folder.rig_file)
    if not rig.all_markers:
        raise IpsysError("lab.toml lists no markers; type the ids of the robots, and save them")
    return _draw(rig_prints(rig))


def print_board(typed: Mapping[str, str]) -> bytes:
    """Return a calibration board as PDF (``ipsys markers --board 6x4``); ``typed`` are texts by field.

    Raises
    ------
    IpsysError
        A field has a fault, or the board is larger than a page. Or Matplotlib is not installed.
    """
    entry = parse_board_entry(typed)
    if isinstance(entry, Fault):
        raise IpsysError(entry.text)
    return _draw([board_print(entry.parse(), entry.board)])


def _draw(prints: list[Print]) -> bytes:
    check_installed("a print needs", "matplotlib")
    from ipsys_log.report.print_pages import choose_paper, draw_pages, lay_out

    return draw_pages(lay_out(prints, choose_paper(prints, None)))
