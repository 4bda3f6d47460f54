"""Sessions of geometric labs with images: the markers come from rendered frames, through detect.

A session is rendered once. Its log, without the images, stays in a folder, and the next run with the same lab
reads it. A session that was interrupted is rendered again; the sessions before it are kept.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from scenes import simulator_key
from stops import PacedDrive

from ipsys_log.capture.simulation.calibration_points import place_marker
from ipsys_log.capture.simulation.cameras import FloorView, prepare_view
from ipsys_log.capture.simulation.lab import moving_marker
from ipsys_log.capture.simulation.render import encode_jpeg, render
from ipsys_log.capture.simulation.settings import Purpose, random_stream
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, CompressedImage, Markers, Message, Rig
from ipsys_log.stages.detect import STAGE, FrameDetector
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.markers import MovingMarker, PlacedMarker
from tests.geometric.lab import GeometricLab
from tests.geometric.session import simulate_session
from tests.geometric.sightings import start_ns, still_times_ns

__all__ = ["rendered_session"]

# Frames that wait for detect while others are rendered.
_TOGETHER = 6


def rendered_session(lab: GeometricLab, folder: Path) -> list[Message]:
    """Return the messages of a session of a lab with images; render it if the folder does not have it.

    Times, poses, points, tape readings and intrinsics are those of the session without images. The robots are
    on a flat floor.
    """
    settings = lab.settings
    if settings.floor_rms_m or settings.wobble_deg or settings.marker_scale_sigma:
        raise SystemExit("rendered labs have a flat floor and equal markers; leave out --rendered")
    kind = "drive" if settings.lab.drive_s else "points"
    path = folder / f"{settings.lab.seed}_{kind}_{_key(lab)}.mcap"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        begin = time.process_time()
        write_log(path, _through_images(lab))
        spent_s = time.process_time() - begin
        print(f"rendered {path.name} in {spent_s:.0f} s of processor time", file=sys.stderr, flush=True)
    with Session([path]) as session:
        return list(session.messages({topic for reader in session.readers for topic in reader.channels}))


def _key(lab: GeometricLab) -> str:
    drive_paces = lab.drive.paces if isinstance(lab.drive, PacedDrive) else {}
    paces = {robot: (one.times_s.tolist(), one.shares.tolist()) for robot, one in drive_paces.items()}
    return simulator_key(f"{lab.settings} {lab.drive.path} {paces} {dict(STAGE.versions)}")


def _through_images(lab: GeometricLab) -> Iterator[Message]:
    """Yield the messages of the session, with the markers that detect finds in rendered frames."""
    detect, messages = FrameDetector(), list(simulate_session(lab))
    frames = [message for message in messages if isinstance(message.payload, Markers)]
    images = _images(lab, frames)
    for message in messages:
        if isinstance(message.payload, Markers):
            (markers,) = (one for one in detect(next(images)) if isinstance(one, Markers))
            yield replace(message, payload=markers)
            continue
        if isinstance(message.payload, (Rig, CameraCalibration)):
            list(detect(message))
        yield message


def _images(lab: GeometricLab, frames: Sequence[Message]) -> Iterator[Message]:
    views = {camera.name: prepare_view(camera, lab.settings.lab) for camera in lab.cameras}
    shutter = _Shutter(lab, views, _still_sets(lab))
    with ThreadPoolExecutor() as pool:
        for first in range(0, len(frames), _TOGETHER):
            together = frames[first : first + _TOGETHER]
            yield from pool.map(shutter, range(first, first + len(together)), together)


def _still_sets(lab: GeometricLab) -> dict[int, int]:
    """Return the set of calibration points by the instant of a frame of all cameras."""
    return {
        time_ns: number
        for number in range(len(lab.points))
        for time_ns in still_times_ns(lab, number).tolist()
    }


@dataclass(frozen=True, slots=True)
class _Shutter:
    """The renderer of the frames of a session."""

    lab: GeometricLab
    views: dict[str, FloorView]
    still_sets: dict[int, int]

    def __call__(self, index: int, frame: Message) -> Message:
        settings, camera = self.lab.settings.lab, str(frame.camera)
        rng = random_stream(settings.seed, Purpose.FRAME, index)
        image = render(self.views[camera], self._prints(camera, frame.publish_time_ns), settings, rng)
        data = encode_jpeg(image, settings)
        return replace(frame, payload=CompressedImage(frame.publish_time_ns, camera, data, "jpeg"))

    def _prints(self, camera: str, stamp_ns: int) -> tuple[PlacedMarker | MovingMarker, ...]:
        lab, settings = self.lab, self.lab.settings.lab
        time_ns = stamp_ns - lab.clock_offsets_ns[camera]
        number = self.still_sets.get(time_ns - lab.frame_delays_ns[camera])
        if number is not None:
            return tuple(place_marker(pose, settings) for pose in lab.points[number])
        since_s = (time_ns - start_ns(lab, len(lab.points))) / NS_PER_S
        return tuple(moving_marker(lab.drive, robot, since_s, settings) for robot in lab.drive.ahead_s)
