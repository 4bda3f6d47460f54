"""Rendered logs with known ground truth, rendered once and kept in ``.cache/bench``."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.capture import simulation
from ipsys_log.capture.simulation.calibration_points import SimulatedPose, place_marker
from ipsys_log.capture.simulation.cameras import mount_cameras
from ipsys_log.capture.simulation.lab import simulate
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, Message
from ipsys_log.messages.channels import TRUTH
from ipsys_log.vision.markers import project_corners

__all__ = ["CACHE", "Truth", "blocks", "drawn", "lengthened", "simulator_key", "truth", "with_restarts"]

# Benchmarks share labs and receivers with the tests.
sys.path.append(str(Path(__file__).resolve().parent.parent))

CACHE = Path(__file__).resolve().parent.parent / ".cache" / "bench"

Corners = NDArray[np.float64]

_PAUSE_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Corners in px, (4, 2), by the id of a marker in a frame; ``whole`` markers are wholly in the image."""

    corners_px: dict[int, Corners]
    whole: frozenset[int]


def drawn(settings: LabSettings) -> Path:
    """Return the log of a session of the simulated lab; render it if it does not exist yet."""
    path = CACHE / f"{simulator_key(str(settings))}.mcap"
    if not path.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        write_log(path, simulate(settings))
    return path


def simulator_key(settings: str) -> str:
    """Return a key of the frames of a session: another simulator or JPEG encoder gives other frames."""
    key = hashlib.blake2b(f"{settings} {cv2.__version__}".encode(), digest_size=8)
    for source in sorted(Path(simulation.__file__).parent.glob("*.py")):
        key.update(source.read_bytes())
    return key.hexdigest()


def with_restarts(path: Path, rows: int = 1) -> Path | None:
    """Return the same log, its JPEGs losslessly rewritten with a restart marker per ``rows`` rows of blocks.

    The result is None without ``jpegtran`` (Debian: libjpeg-turbo-progs). Another program could only decode
    and encode again, and this would change the pixels.
    """
    if shutil.which("jpegtran") is None:
        return None
    target = path.with_name(f"{path.stem}-restart-{rows}.mcap")
    if not target.exists():
        write_log(target, _restarted(path, rows))
    return target


def _restarted(path: Path, rows: int) -> Iterator[Message]:
    command = ["jpegtran", "-copy", "all", "-restart", str(rows)]
    with Session([path]) as session:
        for message in session.messages({topic for reader in session.readers for topic in reader.channels}):
            if isinstance(message.payload, CompressedImage):
                done = subprocess.run(command, input=message.payload.data, capture_output=True, check=True)
                yield replace(message, payload=replace(message.payload, data=done.stdout))
            else:
                yield message


def blocks(path: Path, instants: int) -> list[tuple[int, int]]:
    """Return half-open ranges of log time in ns; each has the same number of frames of every camera."""
    with Session([path]) as session:
        starts = [message.log_time_ns for message in session.messages(session.topics(TRUTH))]
        firsts = starts[::instants]
        return list(zip(firsts, [*firsts[1:], session.end_ns + 1], strict=True))


def truth(path: Path, settings: LabSettings) -> dict[tuple[str, int], Truth]:
    """Return the ground truth of each frame, by camera and publish time in ns."""
    cameras = mount_cameras(settings)
    truths = {}
    with Session([path]) as session:
        for tracks in session.payloads(session.topics(TRUTH)):
            for camera in cameras:
                px = {}
                for track in tracks.tracks:
                    where = SimulatedPose(track.id, track.x_m, track.y_m, track.z_m, track.heading_rad)
                    printed = place_marker(where, settings)
                    px[track.id] = project_corners(camera.lens, camera.camera_from_world, printed)
                whole = frozenset(track.id for track in tracks.tracks if camera.name in track.cameras)
                truths[camera.name, tracks.timestamp] = Truth(px, whole)
    return truths


def lengthened(path: Path, target: Path, frames: int) -> None:
    """Write a longer log of ``frames``: a log, then its last frames forward and backward with new times.

    Nothing jumps; a restart from the first frame would make the robots jump.
    """
    write_log(target, _lengthened(path, frames))


def _lengthened(path: Path, frames: int) -> Iterator[Message]:
    with Session([path]) as session:
        count = 0
        for message in session.messages({topic for reader in session.readers for topic in reader.channels}):
            count += isinstance(message.payload, CompressedImage)
            yield message
        drive = _continuous(list(session.messages(session.images.values())), len(session.images))
    step_ns = drive[-1][0].publish_time_ns - drive[-2][0].publish_time_ns
    shift_ns, order = 0, [*drive[-2::-1], *drive[1:]]
    start_ns = drive[-1][0].publish_time_ns
    while count < frames:
        for instant in order:
            shift_ns += step_ns
            for message in instant[: frames - count]:
                time_ns = start_ns + shift_ns
                log_time_ns = time_ns + message.log_time_ns - message.publish_time_ns
                payload = replace(message.payload, timestamp=time_ns)
                yield Message(message.topic, log_time_ns, time_ns, payload, message.camera)
                count += 1


def _continuous(images: list[Message], cameras: int) -> list[list[Message]]:
    """Return the frames of each instant after the last pause."""
    instants = [images[index : index + cameras] for index in range(0, len(images), cameras)]
    for index in range(len(instants) - 1, 0, -1):
        if instants[index][0].publish_time_ns - instants[index - 1][0].publish_time_ns > _PAUSE_NS:
            return instants[index:]
    return instants
