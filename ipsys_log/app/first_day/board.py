"""The calibration board of the setup: its typed fields, and the search for pictures of it."""

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import simplejpeg

from ipsys_log.calibration.board import Board, parse_board
from ipsys_log.calibration.board_detection import LEAST_CORNERS, BoardSighting, view_board
from ipsys_log.calibration.board_search import NEAR, advise, measure_coverage
from ipsys_log.calibration.lens_models import LENS_MODELS, find_lens_model
from ipsys_log.errors import FrameError, IpsysError
from ipsys_log.live_runs.survey.entry import Fault
from ipsys_log.messages import CompressedImage, CompressedVideo, Grey
from ipsys_log.vision.video import decode_alone, is_keyframe


class BoardEntry(NamedTuple):
    """The options of ``ipsys calibrate`` for a board and a lens, by their names in :func:`api.calibrate`."""

    board: str
    square_m: float
    lens: str
    marker_scale: float
    dictionary: str
    inverted: bool

    def parse(self) -> Board:
        """Return the board."""
        return parse_board(self.board, self.square_m, self.marker_scale, self.dictionary, self.inverted)


# The dictionaries that the page offers.
DICTIONARIES = (
    *("DICT_4X4_50", "DICT_4X4_100", "DICT_4X4_250", "DICT_5X5_100", "DICT_6X6_250"),
    *("DICT_APRILTAG_25h9", "DICT_APRILTAG_36h11"),
)
# The fields of the form: key, label, usual text, and the choices if there is a choice.
BOARD_FIELDS: tuple[tuple[str, str, str, tuple[str, ...]], ...] = (
    ("board", "Inner corners of the chessboard, such as 6x4", "6x4", ()),
    ("square", "Side of a square, in m", "0.03", ()),
    ("lens", "Lens distortion model", "fisheye", tuple(LENS_MODELS)),
    ("marker_scale", "ChArUco: side of a marker, as a share of a square", "0.75", ()),
    ("dictionary", "ChArUco: dictionary of the markers", "DICT_4X4_50", DICTIONARIES),
    ("inverted", "ChArUco: black and white exchanged", "no", ("no", "yes")),
)


def parse_board_entry(typed: Mapping[str, str]) -> BoardEntry | Fault:
    """Return the typed options; or the fault of a field, in the words of the command.

    ``typed`` has the texts by field; a missing field has its usual text.
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


# So many pictures, without advice on further ones, are enough.
_ENOUGH = 20
# The picture on the page is smaller than that of the camera.
_SHOWN_WIDTH_PX = 640
_QUALITY = 70


class BoardSearch:
    """The search for a board in the images of one camera, and the pictures that it keeps.

    One thread calls :meth:`look`, and another one reads the state.

    Parameters
    ----------
    camera, board : name of the camera, and the board to search for; ``camera`` is also an attribute.
    folder : an existing folder for the pictures.

    Attributes
    ----------
    count : number of kept pictures.
    is_enough : the kept pictures cover the image and enough poses.
    """

    def __init__(self, camera: str, board: Board, folder: Path) -> None:
        self.count, self.is_enough = 0, False
        self.camera, self._board, self._folder = camera, board, folder
        self._kept: list[BoardSighting] = []
        self._lock = threading.Lock()
        self._number = 0
        self._shown: bytes | None = None
        self._state: dict[str, Any] = {}

    def look(self, image: CompressedImage | CompressedVideo) -> None:
        """Search for the board in an image, and keep the image if it shows a new pose."""
        if isinstance(image, CompressedVideo) and not is_keyframe(image):
            return
        try:
            grey = decode_alone(image)
        except FrameError:
            return
        sighting = view_board(f"{self.count}", grey, self._board, thorough=False).sighting
        if sighting is not None and len(sighting.ids) >= LEAST_CORNERS and self._is_new(sighting, grey):
            self._keep(sighting, grey)
        self._show(sighting, grey)

    def describe(self) -> dict[str, Any]:
        """Return the state as plain data; the outlines and the present board are in px of the image."""
        with self._lock:
            return dict(self._state)

    def picture(self) -> bytes | None:
        """Return the last image, smaller, as JPEG."""
        with self._lock:
            return self._shown

    def _is_new(self, sighting: BoardSighting, grey: Grey) -> bool:
        """Return whether a board differs from all kept ones by 3 % of the image diagonal."""
        near_px = NEAR * float(np.hypot(*grey.shape))
        moved_px = (np.linalg.norm(sighting.outline - other.outline, axis=1).mean() for other in self._kept)
        return all(distance_px >= near_px for distance_px in moved_px)

    def _keep(self, sighting: BoardSighting, grey: Grey) -> None:
        self._kept.append(sighting)
        self.count = len(self._kept)
        # PNG: a second compression would move the corners.
        (self._folder / f"{self.count:03d}.png").write_bytes(cv2.imencode(".png", grey)[1].tobytes())

    def _show(self, sighting: BoardSighting | None, grey: Grey) -> None:
        height, width = grey.shape
        scale = min(1.0, _SHOWN_WIDTH_PX / width)
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        shown = simplejpeg.encode_jpeg(
            np.ascontiguousarray(small)[..., None], quality=_QUALITY, colorspace="GRAY"
        )
        advice = ["hold the board into the image"]
        if self._kept:
            pixels = np.concatenate([one.pixels for one in self._kept])
            outlines = np.stack([one.outline for one in self._kept])
            advice = advise(measure_coverage(pixels, (width, height), outlines))
            self.is_enough = not advice and self.count >= _ENOUGH
        with self._lock:
            self._number += 1
            self._shown = shown
            self._state = {
                "camera": self.camera,
                "number": self._number,
                "count": self.count,
                "size_px": [width, height],
                "kept_px": [one.outline.round().tolist() for one in self._kept],
                "board_px": None if sighting is None else sighting.outline.round().tolist(),
                "advice": advice or ["tilt the board to all sides, near and far"],
            }
