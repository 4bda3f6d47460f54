"""Live recordings with late frames, and on a machine that is too slow: replay gives the same results."""

import shutil
from itertools import zip_longest
from math import inf
from pathlib import Path

import pytest

from ipsys_log.capture.lab import first_messages
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.messages import FRAME_SKIPPED, STAMP_UNRELIABLE, Event
from ipsys_log.messages.channels import POSITIONS
from ipsys_log.stages.detect import Detect
from ipsys_log.units import NS_PER_S
from tests.live_recordings import RATE_HZ, again, go_live, lenses, sent, slow
from tests.playing import SteppedClock, cameras, playing


class Jumping(SteppedClock):
    """A clock that jumps once by 2 s, as of a recorder that was suspended; before the given frame."""

    def jump(self, camera: str, number: int) -> None:
        self.before(camera, number)
        if (camera, number) == (min(self._names), 10):
            with self._changed:
                self._start_ns += 2 * NS_PER_S
                self._now_ns += 2 * NS_PER_S


@pytest.fixture(scope="session")
def stalled(lab_log: Path, calibration: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record cameras without stamps, with a program that pauses for 2 s after their tenth frame."""
    target = tmp_path_factory.mktemp("stalled") / "live.mcap"
    frames = {name: [*found[:10], *found[9:0:-1], *found[:10]] for name, found in sent(lab_log).items()}
    clock = Jumping(list(frames), RATE_HZ)
    with Session([lab_log]) as session:
        (rig,) = session.payloads(["/rig"])
    attached = LiveCameras(cameras(*frames), playing(frames, inf, False, clock.jump), clock)
    settings = first_messages(rig, lenses(lab_log), attached.now_ns)
    with attached:
        request = Request(model_from=calibration)
        pipeline.live(attached, settings, target, request, sinks=[clock.watch])
    return target


def test_live_with_late_frames_equals_replay(stalled: Path, calibration: Path) -> None:
    found = again(stalled)
    assert "/runs/poly/tracks" in {one.topic for one in found}
    assert all(one.equal and one.left > 0 for one in found)
    before = stalled.read_bytes()
    outcomes = pipeline.replay([stalled], Request(model_from=calibration, as_live=True))
    assert not any(one.fresh for one in outcomes)
    assert stalled.read_bytes() == before


def late_ranges(events: list[Event]) -> dict[str, list[tuple[float, float]]]:
    """Return the times of late frames by camera, from the two events of each stall."""
    ranges: dict[str, list[tuple[float, float]]] = {}
    for camera in {str(event.camera) for event in events}:
        mine = [event for event in events if event.camera == camera]
        for begins, ends in zip_longest(mine[::2], mine[1::2]):
            assert (begins.start is None, begins.end) == (False, None)
            end_ns = inf if ends is None else ends.end
            ranges.setdefault(camera, []).append((begins.start or 0, end_ns or 0))
    return ranges


def test_late_frames_are_named_and_in_no_track(stalled: Path) -> None:
    with Session([stalled]) as session:
        events = [e for e in session.payloads(["/events"]) if e.kind == STAMP_UNRELIABLE]
        tracks = session.payloads(["/runs/poly/tracks"])
        positions = list(session.messages(session.topics(POSITIONS, "poly")))
        (fused,) = (run for run in session.runs() if run.stage == "fuse")
    ranges = late_ranges(events)
    for camera in ("black", "red", "white"):
        assert any(end_ns - start_ns > 1.9e9 for start_ns, end_ns in ranges[camera])
    late = {
        m.publish_time_ns
        for m in positions
        if any(start_ns <= m.publish_time_ns <= end_ns for start_ns, end_ns in ranges[str(m.camera)])
    }
    assert len(late) >= 3
    tracked = {one.timestamp for one in tracks}
    # The markers are carried between points: some sightings contradict the tracks.
    assert tracked <= {m.publish_time_ns for m in positions} - late
    assert len(tracked) > len(positions) / 2
    assert "/events" in {read.topic for read in fused.inputs}


@pytest.fixture(scope="session")
def overloaded_log(lab_log: Path, calibration: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record on a machine that is too slow for its cameras; tests copy the log before a change."""
    target = tmp_path_factory.mktemp("overloaded") / "live.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Detect, "__call__", slow(Detect.__call__))
        go_live(lab_log, calibration, target, 30.0)
    return target


@pytest.fixture
def overloaded(overloaded_log: Path, tmp_path: Path) -> Path:
    """Copy the recording of a slow machine."""
    return Path(shutil.copy(overloaded_log, tmp_path / "overloaded.mcap"))


def test_runs_of_logs_without_late_frames_read_no_events(overloaded: Path) -> None:
    """The runs are the same as without such an event."""
    with Session([overloaded]) as session:
        assert session.count("/events") > 0
        read = {read.topic for run in session.runs() for read in run.inputs if run.stage == "fuse"}
    assert read == {"/rig", "/runs/poly/model"} | {topic for topic in read if topic.endswith("/positions")}


def test_slow_machine_records_and_names_skipped_frames(
    overloaded: Path, lab_log: Path, calibration: Path
) -> None:
    with Session([overloaded]) as session, Session([lab_log]) as sent:
        events: list[Event] = session.payloads(["/events"])
        skipped = {e.timestamp for e in events if e.kind == FRAME_SKIPPED}
        frames = {m.log_time_ns for m in session.messages(session.images.values())}
        markers = {
            m.log_time_ns
            for m in session.messages([f"/runs/edges/cameras/{camera}/markers" for camera in session.images])
        }
        assert all(
            session.count(topic) == sent.count(sent.images[name]) for name, topic in session.images.items()
        )
    assert len(skipped) > 5
    assert markers == frames - skipped
    assert all(one.equal for one in again(overloaded))
    # Replay as live, or all frames: the user chooses.
    request = Request(model_from=calibration, as_live=True)
    assert not any(one.fresh for one in pipeline.replay([overloaded], request))
    assert all(
        one.fresh
        for one in pipeline.replay([overloaded], Request(model_from=calibration))
        if one.stage != "fit"
    )
    with Session([overloaded]) as session:
        assert sum(session.count(f"/runs/edges_2/cameras/{c}/markers") for c in session.images) == len(frames)
