"""Clock offsets of the logs of a merge: given by the user, or estimated from markers that both saw moving."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from contextlib import ExitStack
from decimal import Decimal, InvalidOperation

import numpy as np

from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.request import Progress
from ipsys_log.errors import FitError, IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.location import LogLocation
from ipsys_log.messages.channels import MARKERS
from ipsys_log.plain_text import shell_words
from ipsys_log.tools.clock_offset import MarkerPath, estimate_clock_offset
from ipsys_log.tools.merge import open_logs
from ipsys_log.tools.merge_plan import LogOffset, check_logs_differ
from ipsys_log.units import NS_PER_S

_STEP = "clocks"
_LARGEST_S = 1_000_000_000


@one_reading()
def choose_offsets(
    paths: Sequence[LogLocation],
    texts: Sequence[str],
    progress: Progress = lambda stage, done, total: None,
) -> list[LogOffset]:
    """Return the offset of each log: of an option ``NAME=SECONDS``, or estimated; 0 for the first log.

    An offset is estimated against all earlier logs, at the times of the first clock.

    Raises
    ------
    IpsysError
        An option names no log, or an offset cannot be estimated.
    """
    given = _given_offsets(paths, texts)
    if len(given) == len(paths) - 1:
        return [given.get(number, LogOffset()) for number in range(len(paths))]
    offsets: list[LogOffset] = []
    earlier: list[MarkerPath] = []
    with ExitStack() as stack:
        sessions = open_logs(paths, stack)
        check_logs_differ(sessions)
        zero_ns = sessions[0].start_ns
        for number, session in enumerate(sessions):
            progress(_STEP, number, len(sessions))
            offset = given.get(number, LogOffset())
            needs_estimate = number > 0 and number not in given
            own = _marker_paths(session, zero_ns) if needs_estimate or number + 1 < len(paths) else []
            if needs_estimate:
                offset = _estimate(session, earlier, own)
            shift_s = offset.offset_ns / NS_PER_S
            earlier += [path._replace(times_s=path.times_s + shift_s) for path in own]
            offsets.append(offset)
    return offsets


def _estimate(session: Session, earlier: Sequence[MarkerPath], own: Sequence[MarkerPath]) -> LogOffset:
    """Estimate the offset of a log from the paths of its markers and those of earlier logs.

    Raises
    ------
    IpsysError
        The offset cannot be estimated.
    """
    option = f"--offset {session.paths[0].stem}=SECONDS"
    try:
        estimate = estimate_clock_offset(earlier, own)
    except FitError as error:
        raise IpsysError(
            f"{session}: its clock offset cannot be estimated from markers in its images and in those of the "
            f"earlier logs: {error}; let a robot stop and go where both see it, run ipsys replay --until "
            f"detect on a log with skipped frames, or give {option}"
        ) from None
    return LogOffset(round(estimate.offset_s * NS_PER_S), estimate.sigma_s)


def _marker_paths(session: Session, zero_ns: int) -> list[MarkerPath]:
    """Return the paths of the markers in the images of each camera, by the newest run with markers.

    Raises
    ------
    IpsysError
        The log has no markers.
    """
    run = newest_run(session, MARKERS)
    if run is None:
        raise IpsysError(
            f"{session}: has no markers, so its clock offset cannot be estimated; run: "
            f"ipsys replay --until detect {shell_words(*session.paths)}, or give all offsets: "
            f"--offset {session.paths[0].stem}=SECONDS"
        )
    rows: defaultdict[tuple[str, int], list[tuple[int, float, float]]] = defaultdict(list)
    for message in session.messages(session.topics(MARKERS, run)):
        for marker in message.payload.markers:
            time_ns = message.publish_time_ns + (marker.time_offset_ns or 0)
            x_px, y_px = marker.corners_px.mean(axis=0).tolist()
            rows[str(message.camera), marker.id].append((time_ns - zero_ns, x_px, y_px))
    return [_path(camera, marker_id, found) for (camera, marker_id), found in sorted(rows.items())]


def _path(camera: str, marker_id: int, rows: list[tuple[int, float, float]]) -> MarkerPath:
    table = np.array(rows, dtype=np.float64)
    _, first = np.unique(table[:, 0], return_index=True)  # ascending times
    return MarkerPath(camera, marker_id, table[first, 0] / NS_PER_S, table[first, 1:])


def _given_offsets(paths: Sequence[LogLocation], texts: Sequence[str]) -> dict[int, LogOffset]:
    """Return the offsets of the options by the number of their log."""
    given: dict[int, LogOffset] = {}
    for text in texts:
        name, _, value = text.rpartition("=")
        numbers = [number for number, path in enumerate(paths) if name in (str(path), path.name, path.stem)]
        if len(numbers) != 1:
            known = ", ".join(path.stem for path in paths[1:])
            raise IpsysError(
                f"--offset {text}: does not name one log; write NAME=SECONDS with one of {known}"
            )
        if numbers[0] == 0:
            raise IpsysError(f"--offset {text}: the clock of the first log counts; give the other offsets")
        if numbers[0] in given:
            raise IpsysError(f"--offset {text}: the log has two offsets; give one")
        given[numbers[0]] = LogOffset(_parse_seconds(text, value))
    return given


def _parse_seconds(text: str, value: str) -> int:
    try:
        seconds = Decimal(value)
    except InvalidOperation:
        seconds = Decimal("nan")
    if not seconds.is_finite() or abs(seconds) > _LARGEST_S:
        raise IpsysError(f"--offset {text}: has no valid number of seconds; write it as NAME=0.012")
    return round(seconds * NS_PER_S)
