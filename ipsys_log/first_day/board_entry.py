"""Typed fields of a calibration board and a lens model, and their faults, as options of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from ipsys_log.calibration.board import Board, parse_board
from ipsys_log.calibration.lens_models import LENS_MODELS, find_lens_model
from ipsys_log.errors import IpsysError
from ipsys_log.survey.entry import Fault


class BoardEntry(NamedTuple):
    """The options of ``ipsys calibrate`` for a board and a lens, by their names in :func:`api.calibrate`."""

    board: str
    square_m: float
    lens: str
    marker_scale: float
    dictionary: str
    inverted: bool

    def parse(self) -> Board:
        """Return the board.

        Raises
        ------
        IpsysError
            A value is not valid.
        """
        return parse_board(self.board, self.square_m, self.marker_scale, self.dictionary, self.inverted)


# The fields of the form: key, label, usual text, and the choices if there is a choice.
BOARD_FIELDS: tuple[tuple[str, str, str, tuple[str, ...]], ...] = (
    ("board", "Inner corners of the chessboard, such as 6x4", "6x4", ()),
    ("square", "Side of a square, in m", "0.03", ()),
    ("lens", "Lens distortion model", "fisheye", tuple(LENS_MODELS)),
    ("marker_scale", "ChArUco: side of a marker, as a share of a square", "0.75", ()),
    ("dictionary", "ChArUco: dictionary of the markers", "DICT_4X4_50", ()),
    ("inverted", "ChArUco: black and white exchanged", "no", ("no", "yes")),
)


def parse_board_entry(typed: Mapping[str, str]) -> BoardEntry | Fault:
    """Return the typed options; or the fault of a field, in the words of the command.

    Parameters
    ----------
    typed : texts by field; a missing field has its usual text.
    """
    texts = {key: typed.get(key, usual).strip() for key, _, usual, _ in BOARD_FIELDS}
    try:
        entry = BoardEntry(
            texts["board"],
            _number("square", texts["square"]),
            texts["lens"],
            _number("marker_scale", texts["marker_scale"]),
            texts["dictionary"],
            texts["inverted"] == "yes",
        )
        find_lens_model(entry.lens)
        entry.parse()
    except IpsysError as error:
        option, _, _ = str(error).removeprefix("--").replace("-", "_").partition(" ")
        return Fault(option if option in texts else "board", str(error))
    return entry


def _number(field: str, text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        option = field.replace("_", "-")
        raise IpsysError(f"--{option} {text}: is not a number; write 0.03, for example") from error
