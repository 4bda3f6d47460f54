"""Video above the machine's capacity: frames are skipped, and live still equals replay."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.capture.frames import Clock
from ipsys_log.capture.lab import first_messages
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.capture.network import open_network
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.messages import FRAME_SKIPPED, CompressedVideo, Message, RigCamera
from ipsys_log.messages.channels import RUN_EVENTS
from ipsys_log.stages.detect import Detect
from ipsys_log.tools.verify import verify
from ipsys_log.vision.video import Video, is_keyframe
from tests.capture.streams import encode, serve
from tests.ports import free_port
from tests.waiting import wait_until

H264 = ("-c:v", "libx264", "-preset", "ultrafast", "-g", "20", "-bf", "0", "-pix_fmt", "yuv420p")
H265 = ("-c:v", "libx265", "-preset", "ultrafast", "-x265-params", "keyint=20:bframes=0:log-level=none")
FRAMES = 105


@contextmanager
def streamed(lab: Path, folder: Path, *options: str) -> Iterator[str]:
    """Return the address of FFmpeg's video stream of the red camera at 30 Hz."""
    with Session([lab]) as session:
        for number, frame in enumerate(session.payloads([session.images["red"]])):
            (folder / f"{number:03}.jpg").write_bytes(frame.data)
    path, port = encode(folder, "video.mp4", *options), free_port()
    play = ("-re", "-stream_loop", "-1", "-i", str(path), "-c", "copy", "-f", "mpegts", "-listen", "1")
    address = f"http://127.0.0.1:{port}/live"
    with serve(*play, address, port=port):
        yield address


def wait_for_frames(attached: LiveCameras, count: int) -> None:
    """Wait until a camera has sent a number of frames, or is stopped."""
    state = attached.states["red"]
    wait_until(
        lambda: state.frames >= count or attached.is_stopped, f"red has sent {count} frames", lambda: state
    )


Machine = Callable[[pytest.MonkeyPatch, LiveCameras], None]


def go_live(lab: Path, address: str, target: Path, machine: Machine) -> None:
    """Record some frames with a slow machine, up to the markers."""
    attached = LiveCameras([RigCamera("red", source=address)], open_network, Clock())
    with Session([lab]) as session:
        (rig,) = session.payloads(["/rig"])
        lens = session.payloads([session.calibrations["red"]])[0]

    def stop() -> None:
        wait_for_frames(attached, FRAMES)
        attached.stop()

    with attached, pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(1) as stopper:
        machine(patch, attached)
        settings = first_messages(rig, {"red": lens}, attached.now_ns)
        stopped = stopper.submit(stop)
        pipeline.live(attached, settings, target, Request(), "detect")
        stopped.result()


def slow_search(patch: pytest.MonkeyPatch, attached: LiveCameras) -> None:
    """A machine that decodes in time; while it searches one frame, six others arrive."""
    step: Callable[..., Any] = Detect.__call__

    def slower(self: Detect, message: Message) -> Any:
        if isinstance(message.payload, CompressedVideo):
            wait_for_frames(attached, attached.states["red"].frames + 6)
        return step(self, message)

    patch.setattr(Detect, "__call__", slower)


def slow_decoding(patch: pytest.MonkeyPatch, attached: LiveCameras) -> None:
    """A machine that does not decode in time: while it decodes one frame, three others arrive."""
    step = Video._next

    def slower(self: Video, frame: CompressedVideo) -> Any:
        wait_for_frames(attached, attached.states["red"].frames + 3)
        return step(self, frame)

    patch.setattr(Video, "_next", slower)


# A recording in real time, on a machine that is too slow for it.
@pytest.mark.slow
@pytest.mark.parametrize(("codec", "machine"), [(H264, slow_search), (H265, slow_decoding)])
def test_skipped_video_frames_are_equal_in_a_replay(
    codec: tuple[str, ...], machine: Machine, lab_log: Path, tmp_path: Path
) -> None:
    target = tmp_path / "live.mcap"
    with streamed(lab_log, tmp_path, *codec) as address:
        go_live(lab_log, address, target, machine)
    with Session([target]) as session:
        events = session.payloads(["/events"])
        skipped = {e.timestamp for e in events if e.kind == FRAME_SKIPPED}
        frames = list(session.messages([session.images["red"]]))
        found = list(session.messages(["/runs/edges/cameras/red/markers"]))
        events_of_run = session.payloads(session.topics(RUN_EVENTS, "edges"))
    assert [event.text for event in events_of_run if event.kind in ("corrupt_frame", "no_keyframe")] == []
    assert len(frames) > 60
    assert is_keyframe(frames[0].payload)
    assert len(skipped) > 30
    seen = {one.log_time_ns for one in found}
    assert seen == {one.log_time_ns for one in frames} - skipped
    # The results continue to the end.
    assert len(seen & {one.log_time_ns for one in frames[-25:]}) > 0
    assert all(one.equal and one.left for one in verify([target], None, lambda *_: None))
    assert not any(one.fresh for one in pipeline.replay([target], Request(as_live=True), "detect"))
    pipeline.replay([target], Request(), "detect")
    with Session([target]) as session:
        every = list(session.messages(["/runs/edges_2/cameras/red/markers"]))
    assert {one.log_time_ns for one in every} == {one.log_time_ns for one in frames}
    assert any(one.payload.markers for one in every)
