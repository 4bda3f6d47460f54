"""A small log with known values: pictures of one camera, markers in them, and tracks of robots."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.engine.output import write_log
from ipsys_log.messages import (
    CameraCalibration,
    CompressedImage,
    CompressedVideo,
    Floor,
    Marker,
    Markers,
    Message,
    RawImage,
    Rig,
    RigMarker,
    Run,
    Track,
    Tracks,
)
from ipsys_log.units import NS_PER_S

START_NS = 1_700_000_000 * NS_PER_S
STEP_NS = NS_PER_S // 10
RUN = "lab"
SIZE = (320, 180)
# In the order BGR.
COLOUR = (160, 60, 120)
RIG = Rig("lab", "DICT_4X4_100", 0.2, (RigMarker(0, robot="ada", height_m=0.1),), floor=Floor(4.0, 3.0))
CORNERS = np.array([[100.25, 60.5], [140.0, 61.75], [139.125, 101.0], [99.5, 100.375]])

Image = CompressedImage | CompressedVideo | RawImage


def jpeg(colour: tuple[int, int, int] = COLOUR) -> bytes:
    """Return a picture of one colour."""
    return bytes(cv2.imencode(".jpg", np.full((*SIZE[::-1], 3), colour, np.uint8))[1].tobytes())


def lens(time_ns: int = START_NS) -> CameraCalibration:
    """Return the intrinsics of a fisheye camera."""
    K = np.array([[150.0, 0.0, 159.5], [0.0, 151.0, 89.5], [0.0, 0.0, 1.0]])
    return CameraCalibration(time_ns, "red", *SIZE, "kannala_brandt", np.array([0.1, -0.02, 0.003, 1e-4]), K)


@dataclass(frozen=True)
class PicturedLab:
    """The content of the log.

    ``images`` and ``rows`` are the images and the tracks by the number of their instant; the log has ten
    instants in a second. Only the instants in ``marked`` have markers: one marker, or none in ``empty``.
    """

    images: Mapping[int, Image]
    rows: Mapping[int, tuple[Track, ...]]
    marked: frozenset[int] = frozenset()
    empty: frozenset[int] = frozenset()
    rig: Rig | None = RIG
    corners: NDArray[np.float64] = field(default_factory=lambda: CORNERS)

    def write(self, path: Path) -> Path:
        """Write the log."""
        write_log(path, self._messages())
        return path

    def _messages(self) -> Iterator[Message]:
        if self.rig is not None:
            yield Message("/rig", START_NS - 2, START_NS - 2, self.rig)
        yield Message("/cameras/red/calibration", START_NS - 1, START_NS, lens(), "red")
        for number in sorted({*self.images, *self.rows, *self.marked}):
            yield from self._instant(number)
        end_ns = START_NS + 3600 * NS_PER_S
        yield Message(f"/runs/{RUN}/record", end_ns, end_ns, Run(end_ns, RUN, "import"))

    def _instant(self, number: int) -> Iterator[Message]:
        time_ns = START_NS + number * STEP_NS
        if number in self.images:
            yield Message("/cameras/red/image", time_ns, time_ns, self.images[number], "red")
        if number in self.marked:
            found = () if number in self.empty else (Marker(7, self.corners),)
            markers = Markers(time_ns, found, *SIZE)
            yield Message(f"/runs/{RUN}/cameras/red/markers", time_ns, time_ns, markers, "red")
        if number in self.rows:
            tracks = Tracks(time_ns, self.rows[number])
            yield Message(f"/runs/{RUN}/tracks", time_ns, time_ns, tracks)


def image(number: int, data: bytes | None = None) -> CompressedImage:
    """Return the picture of an instant."""
    return CompressedImage(START_NS + number * STEP_NS, "red", jpeg() if data is None else data, "jpeg")


def track(x_m: float, y_m: float, robot: str = "ada", heading_rad: float | None = None) -> Track:
    """Return a pose with small uncertainties."""
    return Track(robot, {"ada": 0, "bob": 1}[robot], x_m, y_m, 0.1, heading_rad, np.diag([4e-6, 1e-6, 1e-6]))
