"""Images in which only the markers are sharp: a new recording without persons and rooms."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.engine.output import write_log
from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, Grey, Message, RawImage
from ipsys_log.messages.channels import CHANNELS, CUTS, MARKERS
from ipsys_log.plain_text import shell_words
from ipsys_log.vision.decode import decode_grey

# By camera and log time in ns of a frame, the corners of each marker in px, (4, 2).
Corners = Mapping[tuple[str, int], Sequence[NDArray[np.float64]]]

# A marker stays sharp with the white border of its print: 0.3 of its side on each side.
_SHARP = 1.6
# The width of an image in blocks of one grey level.
_BLOCKS = 48
_QUALITY = 95
_STEP = "blur"


def marker_corners(session: Session) -> dict[tuple[str, int], list[NDArray[np.float64]]]:
    """Return the corners of all markers in the newest detection, by camera and log time of the frame.

    Raises
    ------
    IpsysError
        No markers are detected yet.
    """
    run = newest_run(session, MARKERS)
    if run is None:
        raise IpsysError(
            f"{session}: has no markers, which --blur keeps sharp; run: "
            f"ipsys replay --until detect {shell_words(*session.paths)}"
        )
    return {
        (str(message.camera), message.log_time_ns): [
            np.asarray(marker.corners_px, dtype=np.float64) for marker in message.payload.markers
        ]
        for message in session.messages(session.topics(MARKERS, run))
    }


def blur_image(grey: Grey, corners_px: Sequence[NDArray[np.float64]]) -> Grey:
    """Return an image (height, width) with blocks of one grey level everywhere but around the markers.

    A filter that only smooths could be inverted; the mean of a block cannot.

    Parameters
    ----------
    corners_px : of each marker, (4, 2).
    """
    import cv2

    height, width = grey.shape
    block_px = -(-width // _BLOCKS)
    size = (-(-width // block_px), -(-height // block_px))
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    blurred = cv2.resize(small, (width, height), interpolation=cv2.INTER_NEAREST)
    mask = np.zeros(grey.shape, np.uint8)
    for corners in corners_px:
        centre = corners.mean(axis=0)
        outline = centre + _SHARP * (corners - centre)
        cv2.fillConvexPoly(mask, np.round(outline).astype(np.int32), 1)
    return np.where(mask > 0, grey, blurred).astype(np.uint8)


def blur_log(path: Path, output: Path, corners: Corners, progress: Progress) -> None:
    """Write a log with blurred grey images; all other known channels stay as they are.

    Raises
    ------
    IpsysError
        The log has video.
    """
    with Session([path]) as session:
        runs = [None, *session.run_names()]
        topics = [
            topic
            for channel in CHANNELS
            if channel is not CUTS
            for run in runs
            for topic in session.topics(channel, run)
        ]
        write_log(output, _blurred(session, sorted(set(topics)), corners, progress))


def _blurred(
    session: Session, topics: Sequence[str], corners: Corners, progress: Progress
) -> Iterator[Message]:
    images = set(session.images.values())
    total, done = sum(session.count(topic) for topic in images), 0
    for message in session.messages(topics):
        if message.topic not in images:
            yield message
            continue
        sharp = corners.get((str(message.camera), message.log_time_ns), ())
        yield replace(message, payload=_blur_payload(message.payload, sharp, session))
        done += 1
        progress(_STEP, done, total)


def _blur_payload(
    payload: Any, corners_px: Sequence[NDArray[np.float64]], session: Session
) -> CompressedImage:
    import simplejpeg

    if not isinstance(payload, CompressedImage | RawImage):
        raise IpsysError(f"{session}: has video, which --blur cannot change; use --without-images")
    blurred = blur_image(decode_grey(payload), corners_px)
    data = simplejpeg.encode_jpeg(
        np.ascontiguousarray(blurred[..., None]), quality=_QUALITY, colorspace="GRAY"
    )
    return CompressedImage(payload.timestamp, payload.frame_id, data, "jpeg")
