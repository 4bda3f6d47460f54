"""Labs in which nodes send the markers of some cameras, and other cameras send frames."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.capture.camera_thread import imported_run
from ipsys_log.capture.frames import CameraState, Clock, Frame, Open, Say
from ipsys_log.capture.lab import first_messages
from ipsys_log.capture.live_plan import plan_live
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.capture.nodes.wire import MARKERS_FORMAT
from ipsys_log.engine.graph import STAGES, Task, plan_stage
from ipsys_log.engine.output import write_log
from ipsys_log.engine.pieces import plan_pieces
from ipsys_log.engine.provenance import imported_inputs
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.log.codec import encode
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraPoints, Markers, Message, RigCamera
from ipsys_log.messages.channels import CAMERA_POINTS, MARKERS, POSITIONS
from tests.conftest import Ipsys
from tests.live_recordings import RATE_HZ, again, lenses, sent
from tests.playing import SteppedClock, cameras, playing

# Recordings, replays and verifications.
pytestmark = pytest.mark.slow

OF_NODE = "red"


def markers_of(log: Path) -> list[Markers]:
    with Session([log]) as session:
        rows: list[Markers] = session.payloads([MARKERS.topic_of("edges", OF_NODE)])
    return rows


def as_node(other: Open) -> Open:
    """Return an opener whose camera of the node sends the played bytes as markers."""

    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Any]]:
        def with_keys(frames: Iterator[Any]) -> Iterator[Frame]:
            for number, frame in enumerate(frames):
                yield frame._replace(format=MARKERS_FORMAT, session="session", number=number)

        with other(camera, clock, say) as frames:
            yield with_keys(frames) if camera.name == OF_NODE else frames

    return opened


@pytest.fixture(scope="module", params=["live", "record"])
def mixed(
    request: pytest.FixtureRequest, replayed_log: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Return a log of a mixed lab with all results: computed live, or by a replay of the plain recording."""
    target = tmp_path_factory.mktemp("mixed") / "mixed.mcap"
    frames = sent(replayed_log)
    frames[OF_NODE] = [encode(row) for row in markers_of(replayed_log)]
    clock = SteppedClock([name for name in frames if name != OF_NODE], RATE_HZ)
    attached = LiveCameras(cameras(*frames), as_node(playing(frames, inf, before=clock.before)), clock)
    wanted = Request(models=("poly",), model_from=replayed_log)
    with attached:
        with Session([replayed_log]) as session:
            (rig,) = session.payloads(["/rig"])
        settings = first_messages(rig, lenses(replayed_log), attached.now_ns, imported_run(attached.states))
        if request.param == "live":
            pipeline.live(attached, settings, target, wanted, sinks=[clock.watch])
        else:
            pipeline.record(attached, settings, target, [clock.watch])
    if request.param == "record":
        pipeline.replay([target], wanted)
    return target


def points(log: Path) -> list[bytes]:
    with Session([log]) as session:
        rows: list[CameraPoints] = session.payloads([CAMERA_POINTS.topic_of("edges", OF_NODE)])
    return [encode(replace(row, timestamp=0)) for row in rows]


def test_markers_of_a_node_have_the_points_of_its_images(mixed: Path, replayed_log: Path) -> None:
    """The oracle is the session in which all cameras have images."""
    ours, theirs = points(mixed), points(replayed_log)
    assert ours
    assert ours == theirs


def test_positions_come_from_all_cameras(mixed: Path) -> None:
    with Session([mixed]) as session:
        seen = {message.camera for message in session.messages(session.topics(POSITIONS, "poly"))}
        received = session.payloads([MARKERS.topic_of("nodes", OF_NODE)])
        passed_on = session.payloads([MARKERS.topic_of("edges", OF_NODE)])
        (run,) = (run for run in session.runs() if run.stage == "detect")
    assert seen == {"red", "white", "black"}
    assert [encode(row) for row in received] == [encode(row) for row in passed_on]
    assert run.input_runs == ("nodes",)


def test_mixed_log_is_verified_and_complete(mixed: Path, replayed_log: Path) -> None:
    comparisons = again(mixed)
    assert comparisons
    assert all(one.equal and one.left > 0 for one in comparisons)
    assert f"/runs/edges/cameras/{OF_NODE}/markers" in {one.topic for one in comparisons}
    outcomes = pipeline.replay([mixed], Request(models=("poly",), model_from=replayed_log))
    assert not any(one.fresh for one in outcomes)


@pytest.mark.parametrize("camera", [OF_NODE, "white"])
def test_part_of_a_mixed_log_is_verified(mixed: Path, tmp_path: Path, ipsys: Ipsys, camera: str) -> None:
    part = tmp_path / "part.mcap"
    assert ipsys("cut", mixed, "--camera", camera, "-o", part).code == 0
    comparisons = again(part)
    assert all(one.equal for one in comparisons)
    assert f"/runs/edges/cameras/{camera}/markers" in {one.topic for one in comparisons}


def test_markers_of_nodes_are_in_no_piece(mixed: Path, replayed_log: Path) -> None:
    """Workers process the frames of one camera, and would leave the markers out."""
    for log, is_divided in ((mixed, False), (replayed_log, True)):
        with Session([log]) as session:
            task = plan_stage(STAGES[0], session, {}, imported_inputs(session))
            assert isinstance(task, Task)
            assert (plan_pieces(task, session) is not None) == is_divided


def test_usual_corners_are_those_of_the_cameras_with_frames(replayed_log: Path) -> None:
    """A camera that sends markers needs no intrinsics for a recording with detection."""
    states = {
        name: CameraState(format=MARKERS_FORMAT if name == OF_NODE else "jpeg") for name in ("red", "white")
    }
    with Session([replayed_log]) as session:
        (rig,) = session.payloads(["/rig"])
    of_white = {"white": lenses(replayed_log)["white"]}
    plan = plan_live(states, first_messages(rig, of_white, Clock().now_ns), Request(), "detect")
    assert plan.request.corners == "edges"


def test_replay_of_the_recorded_messages_equals_live(mixed: Path, replayed_log: Path, tmp_path: Path) -> None:
    log = tmp_path / "again.mcap"
    with Session([mixed]) as session:
        topics = {topic for reader in session.readers for topic in reader.channels}
        own = [topic for topic in topics if "/runs/" not in topic or topic.startswith("/runs/nodes/")]
        write_log(log, session.messages([topic for topic in own if topic != "/latency"]))
        pipeline.replay([log], Request(models=("poly",), model_from=replayed_log))
        with Session([log]) as replayed:
            derived = [topic for topic in topics if topic.split("/")[2:3] in (["edges"], ["poly"])]
            compared = [topic for topic in derived if not topic.endswith(("/record", "/model"))]
            assert len(compared) > 10
            for topic in compared:
                assert replayed.hash(topic) == session.hash(topic), topic


def test_killed_mixed_recorder_is_completed(
    mixed: Path, replayed_log: Path, tmp_path: Path, ipsys: Ipsys
) -> None:
    """The log has the markers of the live detection, but no record of its run."""
    log = tmp_path / "killed.mcap"
    with Session([mixed]) as session:
        topics = sorted({topic for reader in session.readers for topic in reader.channels})
        kept = [
            topic for topic in topics if "/runs/" not in topic or topic.split("/")[2] in ("nodes", "edges")
        ]

        def messages() -> Iterator[Message]:
            for message in session.messages(kept):
                if not message.topic.endswith("edges/record"):
                    yield message

        write_log(log, messages())
    assert ipsys("repair", log).code == 0
    assert all(one.equal for one in again(log))
    shutil.rmtree(tmp_path, ignore_errors=True)
