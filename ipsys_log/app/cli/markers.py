"""Markers and calibration boards for print: ``ipsys markers``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ipsys_log.app.cli.console import console
from ipsys_log.app.cli.options import named, switch
from ipsys_log.app.report.files import check_file, write_files
from ipsys_log.app.report.rows import counted
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed

if TYPE_CHECKING:
    from ipsys_log.app.report.prints import Print
    from ipsys_log.messages import Rig

RigNow = Annotated[
    Path | None, named("--rig", "FILE", "Print the markers of this rig file, in their true size.")
]
Ids = Annotated[
    str | None,
    named("--ids", "LIST", "Print these ids, such as 1,2,3 or 0-9, instead of the ids of the rig."),
]
Length = Annotated[
    float | None,
    named("--length", "METRES", "Side of the black square, in m, instead of the lengths of the rig."),
]
Dictionary = Annotated[
    str | None,
    named(
        "--dictionary",
        "NAME",
        "Dictionary of --ids without a rig (default: DICT_4X4_100) and of a ChArUco board "
        "(default: DICT_4X4_50).",
    ),
]
BoardName = Annotated[
    str | None,
    named(
        "--board",
        "COLUMNSxROWS",
        "Print a board for ipsys calibrate: inner corners of a chessboard, such as 6x4, or "
        "squares of a ChArUco board, such as charuco:4x5.",
    ),
]
Square = Annotated[float, named("--square", "METRES", "Side of a square of the board, in m.")]
MarkerScale = Annotated[
    float,
    named("--marker-scale", "SHARE", "Side of a ChArUco marker, as a fraction of the side of a square."),
]
PageName = Annotated[
    str | None, named("--page", "NAME", "Paper: a4, letter or a3. Default: a4, or a3 if a4 is too small.")
]
Output = Annotated[Path, named("--output,-o", "FILE", "The PDF to write.")]
Force = Annotated[bool, switch("--force", "Overwrite an existing file.")]

_DICTIONARY, _BOARD_DICTIONARY = "DICT_4X4_100", "DICT_4X4_50"
_MOST = 2000


def markers(
    rig: RigNow = None,
    ids: Ids = None,
    length: Length = None,
    dictionary: Dictionary = None,
    board: BoardName = None,
    square: Square = 0.03,
    marker_scale: MarkerScale = 0.75,
    page: PageName = None,
    output: Output = Path("markers.pdf"),
    force: Force = False,
) -> None:
    """Draw markers and calibration boards as a PDF at true size, with a ruler to check the print.

    Each marker has its white margin, cutting marks, its id and an arrow to its front: the direction of its
    heading. Print at 100 % ("actual size"), and measure the ruler: it is 10 cm long.

    Examples

        ipsys markers --rig lab.toml                # all markers of the rig
        ipsys markers --ids 0-11 --length 0.08 --page letter
        ipsys markers --board 6x4 -o board.pdf      # for ipsys calibrate
    """
    check_installed("markers needs", "matplotlib")
    from ipsys_log.app.report.prints import board_print, choose_paper, draw_pages, lay_out

    if output.suffix.lower() != ".pdf":
        raise IpsysError(f"--output {output}: only a PDF keeps the true size; use a name that ends in .pdf")
    check_file(output, "--output", [])
    if output.exists() and not force:
        raise IpsysError(f"{output}: exists already; give another name, or --force to overwrite it")
    prints = _marker_prints(rig, ids, length, dictionary) if rig or ids else []
    if board is not None:
        from ipsys_log.calibration.board import parse_board

        drawn = parse_board(board, square, marker_scale, dictionary or _BOARD_DICTIONARY, False)
        prints.append(board_print(drawn, board))
    if not prints:
        raise IpsysError("nothing to print: give --rig lab.toml, --ids 0-9 --length 0.1, or --board 6x4")
    paper = choose_paper(prints, page)
    pages = lay_out(prints, paper)
    write_files(output.parent, {output.name: draw_pages(pages)})
    console.print(f"{output} written: {counted(len(pages), 'page')} of {paper.name}, {_contents(prints)}")
    if page is None and paper.name != "A4":
        console.print("A4 is too small. Print on A3, or use --length 0.14 for markers that fit on A4")
    console.print('print at 100 % ("actual size"), and check that the printed ruler is 10 cm long')


def _marker_prints(
    rig: Path | None, ids: str | None, length: float | None, dictionary: str | None
) -> list[Print]:
    from ipsys_log.app.report.prints import rig_prints

    lab = _lab(rig, length, dictionary)
    wanted = None if ids is None else _parse_ids(ids, lab.dictionary)
    if wanted is None and not (lab.markers or lab.reference_markers):
        raise IpsysError(f"{rig}: has no [[markers]]; give ids, such as --ids 0-9")
    return rig_prints(lab, wanted, length)


def _lab(rig: Path | None, length: float | None, dictionary: str | None) -> Rig:
    """Return the rig, or a rig with only a dictionary and a length."""
    from dataclasses import replace

    from ipsys_log.messages import Rig
    from ipsys_log.messages.rig_checks import check_units
    from ipsys_log.messages.rig_file import check_rig, load_rig
    from ipsys_log.stages.detect.stock import marker_detector

    if rig is not None:
        lab = load_rig(rig)
    elif length is None:
        raise IpsysError(
            "--ids: the side of the markers is missing; add --length 0.1 (in m), or --rig lab.toml"
        )
    else:
        lab = Rig("lab", (dictionary or _DICTIONARY).upper(), length)
    marker_detector(lab.dictionary)
    if length is not None:
        lab = replace(lab, marker_length_m=length)
        check_units(check_rig(lab, "--length"), "--length")
    return lab


def _parse_ids(text: str, dictionary: str) -> list[int]:
    """Parse a list of ids of a dictionary, such as ``1,2,5-9``; each id occurs once."""
    from ipsys_log.messages.rig_checks import dictionary_size

    ids: list[int] = []
    for part in text.split(","):
        first, dash, last = (text.strip() for text in part.partition("-"))
        if not first.isdecimal() or (dash and not last.isdecimal()) or len(part) > 12:
            raise IpsysError(f"--ids {text}: is not a list of ids; write 1,2,3 or 0-9")
        ids += range(int(first), min(int(last or first), int(first) + _MOST) + 1)
    size = dictionary_size(dictionary)
    if not ids or (size is not None and max(ids) >= size):
        raise IpsysError(
            f"--ids {text}: {dictionary} has the ids 0 to {(size or 1) - 1}; give ids in this range"
        )
    return list(dict.fromkeys(ids))


def _contents(prints: list[Print]) -> str:
    count = sum(not item.is_board for item in prints)
    parts = [counted(count, "marker")] if count else []
    return " and ".join([*parts, *(item.name for item in prints if item.is_board)])
