"""Contents of a log that a pack keeps: channels, and images in which only the markers are sharp."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.engine.graph import stage_named
from ipsys_log.engine.output import write_log
from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import camera_of_topic, run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, Grey, Message, RawImage
from ipsys_log.messages.channels import CHANNELS, CUTS, MARKERS, MEASUREMENTS, RECORD
from ipsys_log.plain_text import shell_words
from ipsys_log.tools.cut_selection import CutOptions
from ipsys_log.vision.decode import decode_grey


def kept_channels(session: Session, without_images: bool) -> set[str]:
    """Return the topics of derived channels that a pack keeps.

    Imported runs are kept, because no stage can compute them. Without images, the newest markers are kept.
    """
    imported = [run.run for run in session.runs() if stage_named(run.stage) is None]
    kept = {topic for run in imported for topic in _topics(session, run)}
    if session.images and not without_images:
        return kept
    run_name = newest_run(session, MARKERS)
    if run_name is not None:
        kept |= {*session.topics(MARKERS, run_name), RECORD.topic_of(run_name)}
    elif session.images:
        raise IpsysError(
            f"{session}: has no markers, which a pack without images needs; run: "
            f"ipsys replay --until detect {shell_words(*session.paths)}"
        )
    return kept


def _topics(session: Session, run: str) -> set[str]:
    return {topic for reader in session.readers for topic in reader.channels if run_of_topic(topic) == run}


def cut_options(session: Session, kept: set[str], without_images: bool, every: int) -> CutOptions | None:
    """Return the options of the cut of one log; None if nothing of it is kept but its settings."""
    topics = {topic for reader in session.readers for topic in reader.channels if session.count(topic)}
    images = set(session.images.values()) if without_images else set()
    runs = {run for topic in topics if (run := run_of_topic(topic)) is not None}
    kept_runs = {run for run in runs if any(run_of_topic(topic) == run for topic in kept & topics)}
    left_out = {topic for topic in topics if run_of_topic(topic) in kept_runs and topic not in kept} | (
        images & topics
    )
    rest = {topic for topic in topics - left_out if run_of_topic(topic) in {None, *kept_runs}}
    if not any(_is_ranged(topic) for topic in rest):
        if MEASUREMENTS.topic in topics:
            raise IpsysError(
                f"{session}: has measurements, but no frames; measure in the log with the frames: "
                "ipsys measure"
            )
        return None
    return CutOptions(
        exclude_topics=[escape(topic) for topic in sorted(left_out)],
        exclude_runs=sorted(runs - kept_runs),
        every=every,
    )


def _is_ranged(topic: str) -> bool:
    """Return whether a topic has messages of instants, and not only settings that hold for the whole log."""
    run, camera = run_of_topic(topic), camera_of_topic(topic)
    return not any(channel.lasting and channel.topic_of(run, camera) == topic for channel in CHANNELS)


# By camera and log time in ns of a frame, the corners of each marker in px, (4, 2).
Corners = Mapping[tuple[str, int], Sequence[NDArray[np.float64]]]

# A marker stays sharp with the white border of its print: 0.3 of its side on each side.
_SHARP = 1.6
# The width of an image in blocks of one grey level.
_BLOCKS = 48
_QUALITY = 95
_STEP = "blur"


def marker_corners(session: Session) -> dict[tuple[str, int], list[NDArray[np.float64]]]:
    """Return the corners of all markers in the newest detection, by camera and log time of the frame."""
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

    ``corners_px`` has those of each marker, (4, 2).
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
    """Write a log with blurred grey images; all other known channels stay as they are."""
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
