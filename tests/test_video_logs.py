"""Logs with H.264 frames: viewed, measured and processed like JPEG logs."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from ipsys_log.capture import live_check
from ipsys_log.capture.frames import CameraState
from ipsys_log.capture.live_check import CameraMonitor
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.live_runs.survey.from_log import open_finished_log
from ipsys_log.live_runs.survey.live import LiveScene
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedVideo, Markers, Message
from ipsys_log.messages.channels import TRACKS
from ipsys_log.sinks.rerun.recording import write_recording
from ipsys_log.sinks.rerun.viewer import LiveView, Write
from ipsys_log.sinks.sink import LiveQueue
from ipsys_log.vision.video import is_keyframe

Grey = NDArray[np.uint8]


@pytest.fixture
def video(video_log: Path, tmp_path: Path) -> Path:
    """Copy the log."""
    return Path(shutil.copy(video_log, tmp_path / "video.mcap"))


def decoded(log: Path, camera: str) -> dict[int, Grey]:
    """Return the images of a camera by time: all packets through FFmpeg at once."""
    with Session([log]) as session:
        frames = list(session.messages([session.images[camera]]))
    whole = BytesIO(b"".join(one.payload.data for one in frames))
    with av.open(whole, "r", format="h264") as container:
        pictures = [cv2.cvtColor(one.to_ndarray(format="bgr24"), cv2.COLOR_BGR2GRAY)
                    for one in container.decode(video=0)]  # fmt: skip
    return dict(zip((one.publish_time_ns for one in frames), pictures, strict=True))  # type: ignore[arg-type]


def assert_shows(jpeg: bytes | None, picture: Grey) -> None:
    assert jpeg is not None
    shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert shown is not None
    assert np.abs(shown.astype(float) - picture).mean() < 2.0


def found_markers(log: Path) -> dict[tuple[str, int], list[int]]:
    with Session([log]) as session:
        topics = [f"/runs/edges/cameras/{camera}/markers" for camera in session.images]
        return {
            (str(m.camera), m.publish_time_ns): [one.id for one in m.payload.markers]
            for m in session.messages(topics)
        }


# Two whole replays; their detections are compared in the fast tier.
@pytest.mark.slow
def test_positions_are_those_of_the_pictures(video: Path, lab: Path) -> None:
    tracks = []
    for log in (video, lab):
        pipeline.replay([log], Request(models=("poly",)))
        with Session([log]) as session:
            tracks.append(
                {
                    (payload.timestamp, track.robot): (track.x_m, track.y_m)
                    for payload in session.payloads(session.topics(TRACKS, "poly"))
                    for track in payload.tracks
                }
            )
    mine, theirs = tracks
    both = mine.keys() & theirs.keys()
    assert len(both) > 0.95 * len(theirs)
    off_m = np.array([np.subtract(mine[key], theirs[key]) for key in both])
    assert np.median(np.hypot(*off_m.T)) < 0.002


# Video of three cameras, decoded for a page.
@pytest.mark.slow
def test_page_shows_the_frames_of_each_stationary_interval(video: Path) -> None:
    """Most of these frames are no keyframes."""
    with open_finished_log(video, Request()) as scene:
        pictures = {camera: decoded(video, camera) for camera in ("black", "red", "white")}
        found = found_markers(video)
        shown = 0
        for stop in range(0, len(scene.intervals), 3):
            for view in scene.views(stop):
                if view.markers is not None:
                    assert_shows(view.jpeg, pictures[view.camera][view.time_ns])
                    assert [m.id for m in view.markers.markers] == found[view.camera, view.time_ns]
                    shown += 1
        assert shown > 20


def test_live_page_shows_the_last_keyframe_with_its_markers(video: Path) -> None:
    pipeline.replay([video], Request(), "detect")
    with Session([video]) as session:
        (rig,) = session.payloads(["/rig"])
        scene = LiveScene(rig, None, {"red": CameraState(up=True)}, lambda topic, payload: None)
        pictures, found = decoded(video, "red"), found_markers(video)
        keys = []
        for message in session.messages([session.images["red"], "/runs/edges/cameras/red/markers"]):
            scene(message)
            if isinstance(message.payload, CompressedVideo) and is_keyframe(message.payload):
                keys.append(message.publish_time_ns)
            elif isinstance(message.payload, Markers):
                (view,) = scene.views(None)
                assert view.time_ns == keys[-1]
                assert_shows(view.jpeg, pictures[view.time_ns])
                assert view.markers is not None
                assert [one.id for one in view.markers.markers] == found["red", view.time_ns]
    assert len(keys) == 3


def test_the_monitor_looks_at_keyframes(video: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline.replay([video], Request(), "detect")
    found = found_markers(video)
    monkeypatch.setattr(live_check, "_EVERY_S", 3600.0)
    with Session([video]) as session:
        (rig,) = session.payloads(["/rig"])
        frames = list(session.messages([session.images["red"]]))
    pictures = decoded(video, "red")
    with CameraMonitor(rig) as looking:
        keys: list[Message] = []
        for frame in frames:
            looking(frame)
            keys += [frame] if is_keyframe(frame.payload) else []
            ((camera, newest),) = looking._newest.items()
            assert (camera, newest) == ("red", keys[-1].payload)
        look = looking._check("red", keys[-1].payload)
    assert set(look.markers) >= set(found["red", keys[-1].publish_time_ns]) != set()
    assert look.brightness == pytest.approx(pictures[keys[-1].publish_time_ns].mean(), abs=3)
    assert look.warnings == ()


def samples(path: Path) -> list[bytes]:
    """Return the frames of the red camera in a recording of Rerun, in order."""
    found: list[tuple[int, Any]] = []
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/cameras/red/image" and "VideoStream:sample" in batch.schema.names:
            times = batch.column("log_time").cast("int64").to_pylist()
            found += zip(times, batch.column("VideoStream:sample").to_pylist(), strict=True)
    return [bytes(data[0]) for _, data in sorted(found)]


def test_rerun_gets_the_bytes_of_the_video(video: Path) -> None:
    path = video.with_suffix(".rrd")
    with Session([video]) as session:
        write_recording(session, save=path)
        sent = [message.payload.data for message in session.messages([session.images["red"]])]
    subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", str(path)], check=True)
    assert samples(path) == sent


def test_a_live_viewer_that_was_too_slow_goes_on_with_a_keyframe(video: Path, tmp_path: Path) -> None:
    def show(feed: Callable[[Write], None]) -> None:
        with (tmp_path / "live.rrd").open("wb") as file:
            feed(file.write)

    with Session([video]) as session:
        (rig,) = session.payloads(["/rig"])
        once = list(session.messages([session.images["red"]]))
    # A part is requested without waiting; then the request continues between two keyframes.
    before = [*(once * 6), *once[:5]]
    came = [*before, *once[5:]]
    frames = [replace(one, log_time_ns=n, publish_time_ns=n) for n, one in enumerate(came, 10**18)]
    waiting = LiveQueue()
    messages = iter(waiting)
    shown: list[Message | None] = []
    for frame in frames[: len(before)]:
        waiting.put(frame)
    shown += iter(messages.__next__, None)
    for frame in frames[len(before) :]:
        waiting.put(frame)
    waiting.close()
    LiveView(rig, ["red"], None, print, show).consume(iter([*shown, *messages]))
    whole = tmp_path / "whole.rrd"
    merge = [sys.executable, "-m", "rerun", "rrd", "merge", str(tmp_path / "live.rrd"), "-o", str(whole)]
    subprocess.run(merge, check=True, capture_output=True)
    assert samples(whole) == [one.payload.data for one in (*frames[:100], *once[10:])]
