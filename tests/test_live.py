"""Live equals replay: the live results equal those from the log, byte for byte."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ipsys_log.capture.frames import Clock
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.capture.recorder import Recording
from ipsys_log.engine.output import append_messages, write_log
from ipsys_log.engine.request import Request
from ipsys_log.engine.view import LogView
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs import pipeline
from ipsys_log.live_runs.survey.checks import check_entry, withdrawal_of
from ipsys_log.live_runs.survey.entry import TypedEntry, parse_entry
from ipsys_log.live_runs.survey.live import LiveScene
from ipsys_log.live_runs.survey.scene import observe_marker
from ipsys_log.log.dataset import Session
from ipsys_log.log.reader import LogReader
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import (
    FRAME_SKIPPED,
    CompressedImage,
    Evaluation,
    Latency,
    Markers,
    Measurement,
    Message,
    Run,
    Tracks,
)
from ipsys_log.messages.channels import CAMERA_POINTS, POSITIONS, RECORD
from ipsys_log.sinks.sink import Sink
from ipsys_log.stages.detect import FrameDetector
from ipsys_log.statistics.calibration_points import find_pairs
from ipsys_log.statistics.calibration_points import measured as measured_places
from ipsys_log.tools.verify import diff, verify
from tests.conftest import Ipsys
from tests.live_recordings import RATE_HZ, again, attached_in_steps, attached_to, sent, settings_of
from tests.playing import WAIT_LIMIT_S, SteppedClock, cameras, playing


def test_live_equals_replay_byte_for_byte(recorded: Path) -> None:
    found = again(recorded)
    assert {one.topic.rpartition("/")[2] for one in found} >= {
        "markers",
        "camera_points",
        "positions",
        "tracks",
    }
    assert all(one.equal and one.left > 0 for one in found)


def test_every_frame_is_in_the_log_as_it_was_sent(recorded: Path, lab_log: Path) -> None:
    with Session([recorded]) as session, Session([lab_log]) as sent:
        for camera, topic in sent.images.items():
            ours = [payload.data for payload in session.payloads([session.images[camera]])]
            assert ours == [payload.data for payload in sent.payloads([topic])]


def test_replay_finds_everything_done(recorded: Path, calibration: Path) -> None:
    before = recorded.read_bytes()
    outcomes = pipeline.replay([recorded], Request(model_from=calibration))
    assert [(one.stage, one.fresh) for one in outcomes] == [
        (stage, False) for stage in ("detect", "camera-frame", "fit", "locate", "fuse")
    ]
    assert recorded.read_bytes() == before


def test_a_position_has_the_times_of_its_steps(recorded: Path) -> None:
    with Session([recorded]) as session:
        entries: list[Latency] = session.payloads(["/latency"])
        tracks = session.count("/runs/poly/tracks")
    assert len(entries) == tracks > 0
    for one in entries:
        assert one.timestamp < one.received <= one.detected <= one.located <= one.fused <= one.published


def tampered(log: Path, target: Path, kind: type, change: Callable[[Any], Any]) -> Path:
    """Copy a log, and change the first message to which a change applies."""
    done = False

    def messages() -> Iterator[Message]:
        nonlocal done
        for message in _copied(log):
            if not done and isinstance(message.payload, kind) and change(message.payload) is not None:
                done = True
                yield replace(message, payload=change(message.payload))
            else:
                yield message

    write_log(target, messages())
    return target


def _one_less(payload: Tracks) -> Tracks | None:
    return replace(payload, tracks=payload.tracks[:-1]) if payload.tracks else None


def _one_digit(payload: Tracks) -> Tracks | None:
    first, *rest = payload.tracks
    return replace(payload, tracks=(replace(first, x_m=first.x_m + 1e-15), *rest))


@pytest.mark.parametrize("change", [_one_less, _one_digit])
def test_a_result_that_was_tampered_with_is_found(
    recorded: Path, tmp_path: Path, change: Callable[[Any], Any]
) -> None:
    log = tampered(recorded, tmp_path / "tampered.mcap", Tracks, change)
    (apart,) = (one for one in again(log, "poly") if not one.equal)
    assert apart.topic == "/runs/poly/tracks"
    assert apart.left - apart.same == 1


def _corner(payload: Markers) -> Markers | None:
    first, *rest = payload.markers or (None,)
    if first is None:
        return None
    return replace(payload, markers=(replace(first, corners_px=first.corners_px + 1e-9), *rest))


def test_changed_marker_is_found_in_all_later_results(recorded: Path, tmp_path: Path) -> None:
    log = tampered(recorded, tmp_path / "tampered.mcap", Markers, _corner)
    apart = {one.topic.rpartition("/")[2]: one.left - one.same for one in again(log) if not one.equal}
    assert apart["markers"] == apart["camera_points"] == 1


def test_unknown_bytes_are_found(recorded: Path, tmp_path: Path) -> None:
    log = tmp_path / "more.mcap"
    with LogReader(recorded) as reader, LogWriter.create(log) as writer:
        for topic, channel in reader.channels.items():
            writer.add_channel(topic, channel.schema, channel.message_encoding)
        for n, one in enumerate(reader.messages()):
            # A field with number 999 is ignored.
            more = b"\xb8\x3e\x01" if one.topic == "/runs/poly/poses" and n > 50 else b""
            writer.write(one.topic, one.log_time_ns, one.publish_time_ns, bytes(one.data) + more)
    assert {one.topic for one in again(log) if not one.equal} == {"/runs/poly/poses"}


def test_one_run_under_two_names_is_the_same(
    ipsys: Ipsys, recorded: Path, calibration: Path, tmp_path: Path
) -> None:
    log = tmp_path / "twice.mcap"
    write_log(log, _copied(recorded))
    pipeline.replay([log], Request(model_from=calibration, run="other"))
    assert all(one.equal and one.left for one in diff(log, log, ("poly", "other")))
    assert ipsys("diff", log, "--run", "poly", "--run", "other").code == 0
    assert "name a second log" in ipsys("diff", log).err


def test_point_measured_later_is_reported_and_no_difference(ipsys: Ipsys, replayed_lab: Path) -> None:
    log = replayed_lab
    with Session([log]) as session:
        last = session.payloads(["/measurements"])[-1]
        time_ns = session.end_ns + 1
    append_messages(log, [Message("/measurements", time_ns, time_ns, withdrawal_of([last], last.id))])
    done = ipsys("verify", log)
    assert done.code == 0, done.out
    assert "its fit is not verified: ipsys replay computes it again" in done.err


def test_a_result_that_is_gone_is_found(recorded: Path, tmp_path: Path) -> None:
    gone = tmp_path / "gone.mcap"
    write_log(gone, (message for message in _copied(recorded) if not isinstance(message.payload, Tracks)))
    assert [one.topic for one in again(gone) if not one.equal] == ["/runs/poly/tracks"]
    unsigned = tmp_path / "unsigned.mcap"
    fuse = [m for m in _copied(recorded) if not (isinstance(m.payload, Run) and m.payload.stage == "fuse")]
    write_log(unsigned, iter(fuse))
    apart = {one.topic: one.first for one in again(unsigned) if not one.equal}
    assert apart.keys() == {"/runs/poly/tracks", "/runs/poly/poses"}
    assert set(apart.values()) == {"no record of the run"}


@pytest.mark.slow
def test_models_and_evaluations_are_computed_again(lab_log: Path, calibration: Path, tmp_path: Path) -> None:
    def apart(log: Path) -> dict[str, bool]:
        return {one.topic: one.equal for one in verify([lab_log, log], None, lambda stage, done, total: None)}

    found = apart(calibration)
    assert {"/runs/poly/model", "/runs/poly/evaluation"} <= found.keys()
    assert all(found.values())

    def other(payload: Evaluation) -> Evaluation:
        return replace(payload, learning=payload.learning[:-1])

    found = apart(tampered(calibration, tmp_path / "tampered.mcap", Evaluation, other))
    assert [topic for topic, equal in found.items() if not equal] == ["/runs/poly/evaluation"]


def test_renamed_robots_are_verified_with_their_rig(
    recorded: Path, calibration: Path, tmp_path: Path
) -> None:
    other = tmp_path / "renamed.mcap"
    write_log(other, _copied(recorded))
    with Session([other]) as session:
        (rig,) = session.payloads(["/rig"])
    named = tuple(replace(marker, robot=f"ada_{marker.id}") for marker in rig.markers)
    pipeline.replay([other], Request(model_from=calibration, rig=replace(rig, markers=named)))
    assert all(one.equal for one in again(other))
    assert any(one.topic == "/runs/poly_2/tracks" for one in again(other))


def test_failed_stage_does_not_stop_the_recording(
    lab_log: Path, calibration: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(self: FrameDetector, message: Message) -> Any:
        raise IpsysError("camera red: its frames are 10 x 10 px")

    target = tmp_path / "x.mcap"
    stopped = threading.Event()

    def before(_: str, number: int) -> None:
        assert number == 0 or stopped.wait(WAIT_LIMIT_S)

    def say(text: str) -> None:
        if "the recording continues" in text:
            stopped.set()

    frames = sent(lab_log)
    attached = LiveCameras(cameras(*frames), playing(frames, inf, before=before), Clock(), say)
    with monkeypatch.context() as patch:
        patch.setattr(FrameDetector, "_frame", broken)
        with attached, pytest.raises(IpsysError, match="has all frames; to process them: ipsys replay"):
            pipeline.live(attached, settings_of(lab_log, attached), target, Request(model_from=calibration))
    with Session([target]) as session:
        assert {name: session.count(topic) for name, topic in session.images.items()} == {
            name: len(found) for name, found in frames.items()
        }
        assert [e.kind for e in session.payloads(["/events"]) if e.kind != FRAME_SKIPPED] == [
            "stages_stopped"
        ]


class Failing:
    """A sink that fails at its n-th message, and gets no more messages."""

    def __init__(self, number: int) -> None:
        self.left = number

    def __call__(self, _: Message) -> None:
        assert self.left > 0, "it is shown more after it failed"
        self.left -= 1
        if not self.left:
            raise ZeroDivisionError("a fault\nin the display")


@pytest.mark.parametrize("number", [1, 20])
@pytest.mark.parametrize("stages", [False, True])
def test_function_that_fails_ends_no_recording(
    lab_log: Path, calibration: Path, tmp_path: Path, stages: bool, number: int
) -> None:
    target = tmp_path / "x.mcap"
    attached, settings, clock = attached_in_steps(lab_log)
    seen: list[Message] = []
    sinks: list[Sink] = [clock.watch, Failing(number), seen.append]
    request = Request(model_from=calibration)
    live = partial(pipeline.live, attached, settings, target, request)
    act = live if stages else partial(pipeline.record, attached, settings, target)
    with attached, pytest.raises(ZeroDivisionError, match="in the display"):
        act(sinks=sinks)
    with Session([target]) as session:
        frames = {name: session.count(topic) for name, topic in session.images.items()}
        assert frames == {name: len(found) for name, found in sent(lab_log).items()}
        assert [e.text for e in session.payloads(["/events"]) if e.kind == "sink_stopped"] == [
            "the display stopped (a fault in the display); the recording continues"
        ]
        signed = {run.stage for run in session.runs()}
        assert signed == ({"detect", "camera-frame", "fit", "locate", "fuse"} if stages else set())
        assert all(e.kind != FRAME_SKIPPED for e in session.payloads(["/events"]))
    images = [one for one in seen if isinstance(one.payload, CompressedImage)]
    assert len(images) == sum(frames.values())
    if stages:
        assert all(one.equal for one in again(target))


class Noting:
    """A stream that notes what it sends."""

    name = "noting"
    payloads: tuple[type, ...] = (Tracks, Latency)

    def __init__(self, steps: list[tuple[str, type, int]]) -> None:
        self._steps = steps

    def send(self, message: Message) -> None:
        self._steps.append(("sent", type(message.payload), message.log_time_ns))


@pytest.mark.slow
def test_position_is_sent_after_its_write_and_before_its_latency(
    lab_log: Path, calibration: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[tuple[str, type, int]] = []
    put = Recording.put

    def noted(self: Recording, message: Message) -> None:
        put(self, message)
        if isinstance(message.payload, (Tracks, Latency)):
            steps.append(("written", type(message.payload), message.log_time_ns))

    monkeypatch.setattr(Recording, "put", noted)
    attached, settings, clock = attached_in_steps(lab_log)
    request = Request(model_from=calibration)
    sinks: list[Sink] = [clock.watch, Noting(steps)]
    with attached:
        pipeline.live(attached, settings, tmp_path / "x.mcap", request, None, sinks)
    assert [step for step, *_ in steps] == ["written", "sent"] * (len(steps) // 2)
    assert [row[1:] for row in steps[::2]] == [row[1:] for row in steps[1::2]]
    times_ns = [time_ns for step, kind, time_ns in steps if (step, kind) == ("sent", Tracks)]
    assert len(times_ns) > 0
    latencies = [
        number for number, (step, kind, _) in enumerate(steps) if (step, kind) == ("written", Latency)
    ]
    assert all(steps[number - 1][2] == steps[number][2] for number in latencies)
    assert len(latencies) == len(times_ns)


def test_frame_that_was_exchanged_is_found(recorded: Path, tmp_path: Path) -> None:
    log = tampered(
        recorded,
        tmp_path / "tampered.mcap",
        CompressedImage,
        lambda image: replace(image, data=image.data + b"\0"),
    )
    with pytest.raises(IpsysError, match=r"run edges is out of date: it has read"):
        again(log)


def test_diff_of_a_log_with_itself_and_of_two_runs(recorded: Path, calibration: Path, tmp_path: Path) -> None:
    assert all(one.equal for one in diff(recorded, recorded, (None, None)))
    other = tmp_path / "other.mcap"
    write_log(other, _copied(recorded))
    pipeline.replay([other], Request(model_from=calibration, corners="stock", run="plain"))
    found = {one.topic: one for one in diff(other, other, ("poly", "plain"))}
    # The markers are carried between the points: the two tracks of a marker can jump at different times.
    positions = [one for topic, one in found.items() if topic.endswith("/positions")]
    assert len(positions) == 3
    for compared in (found["/runs/poly/tracks"], *positions):
        assert not compared.equal
        assert compared.unit == "m"
    assert all(1e-5 < (compared.rms or 0.0) < 0.05 for compared in positions)


def _copied(log: Path) -> Iterator[Message]:
    with Session([log]) as session:
        yield from session.messages({t for reader in session.readers for t in reader.channels})


def test_recording_without_stages_is_detected_later(lab_log: Path, recorded: Path, tmp_path: Path) -> None:
    target = tmp_path / "plain.mcap"
    attached, settings = attached_to(lab_log, 60.0)
    with attached:
        counts = pipeline.record(attached, settings, target)
    with Session([target]) as session:
        assert {topic: session.count(topic) for topic in counts} == dict(counts)
    pipeline.replay([target], Request(), until="detect")
    with Session([target]) as one, Session([recorded]) as other:
        for camera in one.images:
            topic = f"/runs/edges/cameras/{camera}/markers"
            found = [[m.corners_px.tolist() for m in payload.markers] for payload in one.payloads([topic])]
            assert len(found) == other.count(topic)
        assert all(run.stage == "detect" for run in one.runs())


def test_verify_and_diff_on_the_command_line(ipsys: Ipsys, recorded: Path, lab: Path) -> None:
    done = ipsys("verify", recorded)
    assert (done.code, done.err) == (0, "")
    assert done.out.endswith("the replay is identical to the log\n")
    done = ipsys("verify", lab)
    assert done.code == 1
    assert "has no run to verify" in done.err
    assert ipsys("diff", recorded, recorded, "--run", "poly").code == 0
    assert "has no run spline" in ipsys("diff", recorded, recorded, "--run", "spline").err
    assert "has no latencies" in ipsys("latency", lab).err


def test_the_latency_ledger_as_table_and_picture(ipsys: Ipsys, recorded: Path, tmp_path: Path) -> None:
    done = ipsys("latency", recorded, "--plot", tmp_path / "latency.png")
    assert done.code == 0
    *rows, note = done.out.splitlines()[2:]
    assert [line.split()[0] for line in rows] == [
        "received", "detected", "located", "fused", "published", "total",
    ]  # fmt: skip
    assert note == "total: from the arrival of a frame to its position"
    assert (tmp_path / "latency.png").read_bytes()[:4] == b"\x89PNG"
    with Session([recorded]) as session:
        assert [run.stage for run in session.payloads(session.topics(RECORD, "edges"))] == [
            "detect",
            "camera-frame",
        ]


def test_point_measured_during_a_recording_is_used_by_fit(
    lab_log: Path, calibration: Path, tmp_path: Path
) -> None:
    """The distances are those of the lab; the recording has only frames."""
    with Session([lab_log]) as session:
        measured: list[Measurement] = session.payloads(["/measurements"])
        (model,) = Session([calibration]).payloads(["/runs/poly/model"])
        (rig,) = session.payloads(["/rig"])
    ids = {m.marker_id for m in measured if m.marker_id is not None}
    wanted = {m.marker_id: m for m in measured[: len(ids)] if m.marker_id is not None}
    target = tmp_path / "measured.mcap"
    frames = {name: found[:2] * 10 for name, found in sent(lab_log).items()}
    attached, settings, clock = attached_in_steps(lab_log, frames)
    saved: set[int] = set()
    with attached:
        scene = LiveScene(rig, model, attached.states, attached.save)

        def measure(message: Message) -> None:
            scene(message)
            for marker_id, one in wanted.items():
                sight = observe_marker(scene.views(None), marker_id)
                if marker_id in saved or sight.state != "still" or len(sight.points_m) == 0:
                    continue
                typed = TypedEntry(
                    marker=str(marker_id),
                    distances={d.reference: f"{100 * d.distance_m:.2f}" for d in one.distances},
                    side=one.side or "",
                    height=f"{100 * (one.height_m or 0):.2f}",
                )
                entry, wrong = parse_entry(typed, rig)
                checked = check_entry(entry, wrong, rig, sight, scene.history(), model)
                assert checked.measurement is not None, checked.faults
                scene.add([checked.measurement])
                saved.add(marker_id)

        pipeline.live(attached, settings, target, Request(), "camera-frame", [clock.watch, measure])
    assert len(saved) >= 3
    with Session([target]) as session:
        assert [m.marker_id for m in session.payloads(["/measurements"])] == [
            m.marker_id for m in scene.history()
        ]
        view = LogView(session, {CAMERA_POINTS: "edges"})
        places = find_pairs(view, measured_places(view))
    seen = {pair.measurement for found in places.values() for pair in found}
    assert seen == {m.id for m in scene.history()}
    assert all(one.equal for one in again(target))


_MS = 1_000_000
_FRAMES = 18
_USUAL_MS, _LATE_MS, _TOO_LATE_MS, _EARLY_MS = 1, 300, 900, -40


def age_ms(camera: str, number: int) -> int:
    """Return the time from the stamp of a frame to its arrival."""
    if (camera, number) == ("black", 12):
        return _TOO_LATE_MS
    if camera == "red" and number % 4 == 3:
        return _LATE_MS
    return _EARLY_MS if camera == "white" and number % 5 == 3 else _USUAL_MS


def with_gaps(frames: dict[str, list[bytes]]) -> dict[str, list[bytes]]:
    """Return frames of robots that stand still; in some of them, a camera is covered."""
    covered = cv2.imencode(".jpg", np.full((540, 960), 128, dtype=np.uint8))[1].tobytes()
    gaps = {"red": {6}, "white": {4, 5}, "black": {1, 7, 8}}
    return {
        name: [covered if number in gaps[name] else own[number % 2] for number in range(_FRAMES)]
        for name, own in frames.items()
    }


def record_out_of_order(
    lab: Path, calibration: Path, target: Path, age: Callable[[str, int], int]
) -> list[Message]:
    """Record, and return the positions of the log in its order."""
    frames = with_gaps(sent(lab))
    clock = SteppedClock(list(frames), RATE_HZ)
    opened = playing(
        frames, inf, before=clock.before, age_ns=lambda camera, number: _MS * age(camera, number)
    )
    attached = LiveCameras(cameras(*frames), opened, clock)
    settings = settings_of(lab, attached)
    with attached:
        pipeline.live(attached, settings, target, Request(model_from=calibration), sinks=[clock.watch])
    with Session([target]) as session:
        return list(session.messages(session.topics(POSITIONS, "poly")))


@pytest.mark.slow
def test_late_early_and_missing_sightings_replay_alike(
    lab_log: Path, calibration: Path, tmp_path: Path
) -> None:
    log = tmp_path / "live.mcap"
    positions = record_out_of_order(lab_log, calibration, log, age_ms)
    ages_ms = [(m.log_time_ns - m.publish_time_ns) / _MS for m in positions]
    # The log holds all kinds of sightings.
    assert min(ages_ms) < 0
    assert any(_LATE_MS <= age < _TOO_LATE_MS for age in ages_ms)
    assert max(ages_ms) >= _TOO_LATE_MS
    assert sum(not message.payload.positions for message in positions) == 6
    with Session([log]) as session:
        rows = list(session.messages(["/runs/poly/tracks"]))
    times_ns = [message.payload.timestamp for message in rows]
    # A late sighting has its own row, after the rows of later instants; one that is too late has none.
    assert times_ns != sorted(times_ns)
    too_late_ns = positions[int(np.argmax(ages_ms))].publish_time_ns
    assert too_late_ns not in set(times_ns)
    compared = again(log)
    assert "/runs/poly/tracks" in {one.topic for one in compared}
    assert all(one.equal and one.left > 0 for one in compared)
