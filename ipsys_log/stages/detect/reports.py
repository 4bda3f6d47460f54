"""Reports of detection over the whole log: first sightings of unknown markers, and frames of another size."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from ipsys_log.errors import SizeError
from ipsys_log.messages import Event, Markers

__all__ = ["NO_KEYFRAME", "REJECTED_MARKER", "UNKNOWN_MARKER", "OtherSize", "Reports"]

NO_KEYFRAME, REJECTED_MARKER, UNKNOWN_MARKER = _ONCE = ("no_keyframe", "rejected_marker", "unknown_marker")


@dataclass(frozen=True, slots=True)
class OtherSize:
    """A frame of another size than its calibration: its event, its error, and the width and height in px."""

    event: Event
    error: str
    calibrated_px: tuple[int, int]


class Reports:
    """The memory of detection that no reset clears: the events that the log already has.

    It repeats no event of an unknown marker, of a rejected marker with the same reason, or of missing
    keyframes. A frame of another size is an event only after a frame of the camera had the size of its
    calibration.
    """

    def __init__(self) -> None:
        self._said: set[tuple[str | None, str, int | None, str]] = set()
        self._fitted: set[tuple[str | None, tuple[int, int]]] = set()

    def __call__(self, camera: str | None, payloads: Iterable[Any]) -> Iterator[Any]:
        """Yield the payloads of a frame that go into the log.

        Raises
        ------
        SizeError
            The first frame of a camera has another size than its calibration.
        """
        for payload in payloads:
            if isinstance(payload, OtherSize):
                # Without this error, a camera whose frames never fit would give no results at all.
                if (camera, payload.calibrated_px) not in self._fitted:
                    raise SizeError(payload.error)
                yield payload.event
                continue
            if isinstance(payload, Markers):
                self._fitted.add((camera, (payload.width, payload.height)))
            if not isinstance(payload, Event) or self._is_new(payload):
                yield payload

    def _is_new(self, event: Event) -> bool:
        said = event.camera, event.kind, event.marker_id, event.text
        if event.kind not in _ONCE:
            return True
        is_new = said not in self._said
        self._said.add(said)
        return is_new
