"""The centre of a hall: the markers of 24 nodes, its log, and the repetition of its results."""

from collections import defaultdict
from collections.abc import Generator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread

import pytest

from ipsys_log import __version__
from ipsys_log.capture.camera_thread import imported_run
from ipsys_log.capture.devices import source_opener
from ipsys_log.capture.frames import Clock, Open, Say
from ipsys_log.capture.lab import first_messages
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.capture.nodes.network import NodeNetwork
from ipsys_log.capture.nodes.node import Node
from ipsys_log.capture.simulation.settings import hall_settings
from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.log.codec import encode
from ipsys_log.log.dataset import Session
from ipsys_log.messages import FRAME_SKIPPED, Markers, Message, RigCamera, RigNodes, Tracks
from ipsys_log.messages.channels import EVENTS, MARKERS, POSITIONS, TRACKS
from tests.capture.nodes.lab_of_nodes import PATIENCE_S
from tests.conftest import Ipsys
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import MARKERS_RUN, geometric_rig, simulate_session
from tests.ports import free_port

ROBOTS, SECONDS, RATE_HZ = 12, 2.0, 30.0
HALL = hall_settings(6, 4, markers=ROBOTS, rate_hz=RATE_HZ, drive_s=0.0, frames_per_station=2)
MODEL = "rigid"


def calibrate(path: Path) -> None:
    """Write a log with the model of all cameras, from taped points for each of them."""
    points = GeometricSettings(lab=HALL, points=6 * len(HALL.cameras))
    write_log(path, simulate_session(build_lab(points)))
    pipeline.replay([path], Request(models=(MODEL,)), "fit")


def driven_markers(lab: GeometricLab) -> dict[str, list[Markers]]:
    markers: dict[str, list[Markers]] = defaultdict(list)
    for message in simulate_session(lab):
        if isinstance(message.payload, Markers):
            markers[str(message.camera)].append(message.payload)
    return markers


class AnnouncedCameras(LiveCameras):
    """Cameras that announce the begin of the recording; frames before it are discarded."""

    def __init__(self, cameras: list[RigCamera], opener: Open, clock: Clock, say: Say, begin: Event) -> None:
        super().__init__(cameras, opener, clock, say)
        self._begin = begin

    def __iter__(self) -> Generator[Message | None, None, None]:
        messages = super().__iter__()
        yield next(messages)
        self._begin.set()
        yield from messages


def send(
    nodes: dict[str, Node], markers: dict[str, list[Markers]], answered: Event, begin: Event, clock: Clock
) -> None:
    """Send the first markers, which open the cameras, and the others when the centre records.

    Their times are those of the last seconds.
    """
    last_ns = max(row.timestamp for rows in markers.values() for row in rows)
    assert answered.wait(PATIENCE_S)
    later_ns = clock.now_ns() - last_ns
    for number in range(round(SECONDS * RATE_HZ)):
        if number == 1:
            assert begin.wait(PATIENCE_S)
            later_ns = clock.now_ns() - last_ns
        for camera, node in nodes.items():
            row = markers[camera][number]
            stamp_ns = row.timestamp + later_ns
            topic = MARKERS.topic_of(MARKERS_RUN, camera)
            node(Message(topic, stamp_ns, stamp_ns, replace(row, timestamp=stamp_ns), camera))
    for node in nodes.values():
        node.finish(has_ended=True)


def record_hall(folder: Path, lab: GeometricLab, markers: dict[str, list[Markers]]) -> Path:
    """Run the centre with one node for each camera; return its log."""
    network, clock, target = NodeNetwork("127.0.0.1", free_port()), Clock(), folder / "hall.mcap"
    cameras = [RigCamera(name, source=f"zenoh:{name}") for name in lab.settings.lab.cameras]
    names, answered, begin = set[str](), Event(), Event()

    def say(text: str) -> None:
        if "its node answers" in text:
            names.add(text.split(":", maxsplit=1)[0])
        if len(names) == len(cameras):
            answered.set()

    with ExitStack() as stack:
        nodes = {
            camera.name: stack.enter_context(
                Node(camera.name, network, __version__, target, clock, lambda text: None, sends_markers=True)
            )
            for camera in cameras
        }
        sender = Thread(target=send, args=(nodes, markers, answered, begin, clock))
        sender.start()
        stack.callback(sender.join)
        rig = replace(geometric_rig(lab), cameras=tuple(cameras), nodes=RigNodes(str(network)))
        opener = stack.enter_context(source_opener(rig, cameras, folder))
        live = stack.enter_context(AnnouncedCameras(cameras, opener, clock, say, begin))
        settings = first_messages(rig, dict(lab.calibrations), live.now_ns, imported_run(live.states))
        request = Request(models=(MODEL,), model_from=folder / "calibration.mcap")
        pipeline.live(live, settings, target, request)
    return target


def without_times(rows: list[Markers]) -> list[bytes]:
    return sorted(encode(replace(row, timestamp=0)) for row in rows)


@pytest.mark.slow
def test_centre_of_24_nodes_has_all_markers_and_tracks(tmp_path: Path, ipsys: Ipsys) -> None:
    calibrate(tmp_path / "calibration.mcap")
    lab = build_lab(GeometricSettings(lab=replace(HALL, drive_s=SECONDS), points=0))
    markers = driven_markers(lab)
    log = record_hall(tmp_path, lab, markers)
    with Session([log]) as session:
        events = session.payloads(session.topics(EVENTS))
        assert {event.camera for event in events if event.kind == "node_answers"} == set(markers)
        assert not [event for event in events if event.kind == "camera_setting"]
        for camera, sent in markers.items():
            received = session.payloads([MARKERS.topic_of("nodes", camera)])
            received.sort(key=lambda row: row.node_frame)
            assert [row.node_frame for row in received] == list(range(1, round(SECONDS * RATE_HZ)))
            # The times and the keys are those of the centre; all other bytes are those of the node.
            plain = [replace(row, node_session=None, node_frame=None) for row in received]
            assert without_times(plain) == without_times(sent[1:])
        seen_by: dict[int, set[str]] = defaultdict(set)
        for message in session.messages(session.topics(POSITIONS, MODEL)):
            for position in message.payload.positions:
                seen_by[position.id].add(str(message.camera))
        tracks: list[Tracks] = session.payloads([TRACKS.topic_of(MODEL)])
        kinds = {event.kind for event in session.payloads(session.topics(EVENTS))}
    assert all(len(seen_by[marker_id]) >= 2 for marker_id in range(ROBOTS))
    assert {track.robot for row in tracks for track in row.tracks} == {f"robot_{n}" for n in range(ROBOTS)}
    assert not kinds & {FRAME_SKIPPED, "frames_dropped", "node_frames_lost"}
    done = ipsys("verify", log)
    assert done.code == 0, done.out + done.err
