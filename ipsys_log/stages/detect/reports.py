"""Reports of detection over the whole log: unknown markers, other prints, and frames of another size."""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ipsys_log.errors import SizeError
from ipsys_log.messages import CameraCalibration, Event, ImageAnnotations, Marker, Markers
from ipsys_log.messages.events import CALIBRATION_CONTRADICTED, MIRRORED, OTHER_PRINTS
from ipsys_log.statistics.marker_tests import IntrinsicsTest
from ipsys_log.vision.lenses import same_intrinsics

NO_KEYFRAME, REJECTED_MARKER, UNKNOWN_MARKER = ("no_keyframe", "rejected_marker", "unknown_marker")
_ONCE = (NO_KEYFRAME, REJECTED_MARKER, UNKNOWN_MARKER, MIRRORED, OTHER_PRINTS)
# A camera is mirrored if its prints show this number of mirrored ids for each id that is not mirrored.
_CLEARLY_MIRRORED = 2


@dataclass(frozen=True, slots=True)
class OtherSize:
    """A frame of another size than its calibration: its event, its error, and the width and height in px."""

    event: Event
    error: str
    calibrated_px: tuple[int, int]


@dataclass(frozen=True, slots=True)
class LensInUse:
    """The intrinsics that hold from a frame of a camera on."""

    lens: CameraCalibration


@dataclass(frozen=True, slots=True)
class SeenSquares:
    """New markers of a frame, measured or not: their ids, and raw corners x0 y0 .. x3 y3 in px of each."""

    ids: tuple[int, ...]
    corners_px: tuple[float, ...]

    def markers(self) -> list[Marker]:
        corners = np.array(self.corners_px).reshape(-1, 4, 2)
        return [Marker(*row) for row in zip(self.ids, corners, strict=True)]


@dataclass(frozen=True, slots=True)
class OtherPrints:
    """Prints in a frame that are no markers of the rig: the event, and their ids if they are mirrored.

    ``own`` are the ids of the markers in the frame. ``symmetric`` ids do not tell if an image is mirrored.
    """

    event: Event
    ids: tuple[int, ...]
    own: tuple[int, ...]
    symmetric: tuple[int, ...]


class _Prints:
    """The prints that a camera has seen so far."""

    def __init__(self) -> None:
        self.own: set[int] = set()
        self.mirrored: set[int] = set()
        self.others = 0
        self._symmetric: frozenset[int] = frozenset()

    def add(self, prints: OtherPrints) -> None:
        self._symmetric = frozenset(prints.symmetric)
        self.own.update(prints.own)
        if prints.event.kind == MIRRORED:
            self.mirrored.update(prints.ids)
        else:
            self.others += len(prints.ids)

    @property
    def is_mirrored(self) -> bool:
        """Return whether mirror images of ids fit the prints clearly better than ids."""
        return len(self.mirrored) > _CLEARLY_MIRRORED * len(self.own - self._symmetric)


class Reports:
    """The memory of detection that no reset clears: the events that the log already has.

    It repeats no event of an unknown marker, of a rejected marker with the same reason, or of missing
    keyframes. A frame of another size is an event only after a frame of the camera had the size of its
    calibration. Other prints are an event only if the camera has seen no marker of the rig. A mirrored camera
    gives no markers: their positions would be mirrored, too.
    """

    def __init__(self) -> None:
        self._said: set[tuple[str | None, str, int | None, str]] = set()
        self._fitted: set[tuple[str | None, tuple[int, int]]] = set()
        self._tests: dict[str | None, IntrinsicsTest] = {}
        self._prints: defaultdict[str | None, _Prints] = defaultdict(_Prints)

    def __call__(self, camera: str | None, payloads: Iterable[Any]) -> Iterator[Any]:
        """Yield the payloads of a frame that go into the log.

        Raises
        ------
        SizeError
            The first frame of a camera has another size than its calibration.
        """
        squares: SeenSquares | None = None
        for payload in payloads:
            if isinstance(payload, OtherSize):
                # Without this error, a camera whose frames never fit would give no results at all.
                if (camera, payload.calibrated_px) not in self._fitted:
                    raise SizeError(payload.error)
                yield payload.event
                continue
            if isinstance(payload, OtherPrints):
                self._prints[camera].add(payload)
                if self._explains(camera, payload.event) and self._is_new(payload.event):
                    yield payload.event
                continue
            if isinstance(payload, LensInUse):
                self._begin_test(str(camera), payload)
                continue
            if isinstance(payload, SeenSquares):
                squares = payload
                continue
            if isinstance(payload, Markers):
                self._fitted.add((camera, (payload.width, payload.height)))
                self._prints[camera].own.update(marker.id for marker in payload.markers)
                yield from self._test(camera, payload, squares)
                yield self._without_mirrored(camera, self._marked(camera, payload))
            elif not isinstance(payload, Event):
                yield self._without_mirrored(camera, payload)
            elif self._is_new(payload):
                yield payload

    def _begin_test(self, camera: str, used: LensInUse) -> None:
        test = self._tests.get(camera)
        if test is None or not same_intrinsics(test.lens, used.lens):
            self._tests[camera] = IntrinsicsTest(camera, used.lens)

    def _test(self, camera: str | None, frame: Markers, squares: SeenSquares | None) -> Iterator[Event]:
        """Yield an event for each contradiction between the intrinsics of a camera and its markers."""
        test = self._tests.get(camera)
        if test is None or self._prints[camera].is_mirrored:
            return
        contradictions = [] if squares is None else [*test.add_squares(squares.markers())]
        for text in (*contradictions, *test.add(frame.timestamp, frame.markers)):
            yield Event(frame.timestamp, CALIBRATION_CONTRADICTED, text, camera)

    def _marked(self, camera: str | None, frame: Markers) -> Markers:
        """Return a frame whose markers have a mark if they contradict the intrinsics."""
        test = self._tests.get(camera)
        # Models do not rely on nominal intrinsics: joint estimates them.
        if test is None or not test.is_contradicted or not test.lens.D.any():
            return frame
        return replace(frame, markers=tuple(replace(m, contradicted=True) for m in frame.markers))

    def _explains(self, camera: str | None, event: Event) -> bool:
        """Return whether other prints explain why a camera sees no markers."""
        if event.kind == MIRRORED:
            return self._prints[camera].is_mirrored
        return self._prints[camera].others > 1 and not self._prints[camera].own

    def _without_mirrored(self, camera: str | None, payload: Any) -> Any:
        if not self._prints[camera].is_mirrored:
            return payload
        if isinstance(payload, Markers):
            return replace(payload, markers=())
        return ImageAnnotations((), ()) if isinstance(payload, ImageAnnotations) else payload

    def _is_new(self, event: Event) -> bool:
        prints = self._prints[event.camera]
        if event.kind == REJECTED_MARKER and (prints.is_mirrored or (prints.others and not prints.own)):
            return False  # the other print only resembles this marker
        said = event.camera, event.kind, event.marker_id, event.text
        if event.kind not in _ONCE:
            return True
        is_new = said not in self._said
        self._said.add(said)
        return is_new
