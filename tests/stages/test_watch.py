"""The watch over the cameras: knocks are named and repaired, and nothing else accuses a camera."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.api import python_api as api
from ipsys_log.calibration.joint.fit import fit_jointly
from ipsys_log.calibration.joint.from_messages import gather_observations
from ipsys_log.calibration.joint.payload import find_motion, joint_payload, move_camera, restore_joint
from ipsys_log.capture.simulation.lab import EPOCH_NS
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    IMPORTED,
    Array,
    CameraPose,
    Event,
    Markers,
    Measurement,
    Message,
    Model,
    Positions,
    Run,
    calibration_topic,
)
from ipsys_log.messages.channels import CAMERA_POSES, MODEL, POSITIONS, RECORD, RUN_EVENTS
from ipsys_log.messages.events import CAMERA_MOVED, CAMERA_REPAIRED, CLOCK_JUMPED, MARKER_MOVED
from ipsys_log.messages.models import MOVED, PARTLY, REPAIRED
from ipsys_log.statistics.camera_watch import WatchCameras
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.poses import rotation, rotation_vector
from tests.conftest import Ipsys
from tests.geometric.knocks import Disturbance, drive_messages, keep_markers, lying
from tests.geometric.lab import GeometricLab, GeometricSettings, PlacedMarkers, build_lab
from tests.geometric.session import MARKERS_RUN, geometric_rig, simulate_session

SEED, KNOCK_S, END_S = 600, 50.0, 80.0
KNOCK = Disturbance("white", KNOCK_S, (0.003, -0.002, 0.003), (0.001, 0.001, -0.001))
REFERENCES = {90: (1.0, 1.6), 91: (3.9, 1.6), 92: (1.0, 3.3), 93: (3.9, 3.3)}


def build(drive_s: float, **settings: float) -> GeometricLab:
    lab = LabSettings(seed=SEED, rate_hz=10.0, drive_s=drive_s, markers=4, row_time_ns=31_000)
    return build_lab(
        GeometricSettings(
            lab=lab,
            points=8,
            wobble_deg=0.2,
            floor_rms_m=0.001,
            clock_offset_s=0.02,
            frame_delays_s=(0.0, 0.011, 0.022),
            robot_height_sigma_m=0.001,
            marker_scale_sigma=0.001,
        )
    )


@pytest.fixture(scope="module")
def calibration() -> list[Message]:
    return list(simulate_session(build(40.0)))


@pytest.fixture(scope="module")
def model(calibration: list[Message]) -> Model:
    lab = build(40.0)
    markers = {
        name: [m.payload for m in calibration if isinstance(m.payload, Markers) and m.camera == name]
        for name in lab.calibrations
    }
    measured = [m.payload for m in calibration if isinstance(m.payload, Measurement)]
    observations = gather_observations(geometric_rig(lab), lab.calibrations, markers, measured, [])
    return joint_payload(fit_jointly(observations), {}, 0)


@dataclass(frozen=True)
class Watched:
    """The output of a watch, with the times from the start of the drive, in s."""

    events: list[tuple[float, Event]]
    poses: list[tuple[float, CameraPose]]

    def of_kind(self, kind: str) -> list[tuple[float, Event]]:
        return [row for row in self.events if row[1].kind == kind]


def watch(model: Model, messages: Iterable[Message], self_calibrate: bool = True) -> Watched:
    step, events, poses = WatchCameras(model, self_calibrate), [], []
    for message in messages:
        after_s = (message.log_time_ns - EPOCH_NS) / NS_PER_S - 1
        for payload in step(message):
            if isinstance(payload, Event):
                events.append((after_s, payload))
            else:
                poses += [(after_s, pose) for pose in payload.poses]
    return Watched(events, poses)


def in_hand(times_s: Array) -> PlacedMarkers:
    centres_m = np.column_stack(
        [2.4 + 1.2 * np.sin(times_s / 2), 2.4 + 1.5 * np.cos(times_s / 3), 0.9 + 0.2 * np.sin(times_s)]
    )
    turns = [rotation(np.array([0.2 * np.sin(t), 0.2 * np.cos(t), t])) for t in times_s.tolist()]
    return PlacedMarkers(centres_m, np.array(turns))


@pytest.fixture(scope="module")
def knocked(model: Model) -> Watched:
    return watch(model, drive_messages(build(END_S), [KNOCK], 0.2))


def test_knocked_camera_is_named_within_seconds(knocked: Watched) -> None:
    moved = knocked.of_kind(CAMERA_MOVED)
    assert 0 < moved[0][0] - KNOCK_S < 3
    named = [(after_s, pose.camera) for after_s, pose in knocked.poses if pose.state == MOVED]
    assert [camera for _, camera in named] == ["white"]
    assert named[0][0] - KNOCK_S < 6
    since_ns = moved[-1][1].start
    assert since_ns is not None
    assert abs(since_ns - EPOCH_NS - (KNOCK_S + 1) * NS_PER_S) < NS_PER_S


def test_repaired_pose_is_right_to_its_covariance(model: Model, knocked: Watched) -> None:
    after_s, pose = [row for row in knocked.poses if row[1].state == REPAIRED][-1]
    assert after_s < END_S
    motion = np.concatenate([KNOCK.turn_rad, KNOCK.shift_m])
    expected = move_camera(restore_joint(model)["white"], motion)
    turn_rad = rotation_vector(pose.camera_from_world @ expected.camera_from_world.T)
    misses = np.concatenate([turn_rad, pose.position_m - expected.origin_m])
    assert np.degrees(np.linalg.norm(turn_rad)) < 0.01
    assert np.linalg.norm(misses[3:]) < 0.0004
    assert misses @ np.linalg.solve(pose.covariance, misses) < 22.5  # 0.1 % of chi2 with 6


def test_undisturbed_drive_with_a_marker_in_a_hand_has_no_event(model: Model) -> None:
    assert watch(model, drive_messages(build(END_S), (), 0.2, {9: in_hand})) == Watched([], [])


def test_wrong_corners_of_an_entering_marker_are_no_event(model: Model) -> None:
    """The rows of the shutter are not corrected before a marker has a velocity."""

    def enter(message: Message) -> Message:
        frame, after_s = message.payload, (message.log_time_ns - EPOCH_NS) / NS_PER_S
        if not isinstance(frame, Markers) or not 60 < after_s < 61.25:
            return message
        seen = [one for one in frame.markers if one.id != 2 or after_s > 61]
        markers = tuple(
            replace(one, corners_px=enlarge(one.corners_px) if one.id == 2 else one.corners_px)
            for one in seen
        )
        return replace(message, payload=replace(frame, markers=markers))

    def enlarge(corners_px: Array) -> Array:
        middle_px = corners_px.mean(axis=0)
        return np.asarray(middle_px + 1.01 * (corners_px - middle_px))

    assert watch(model, map(enter, drive_messages(build(END_S)))) == Watched([], [])


def test_clocks_of_another_recording_are_reported_and_no_camera(model: Model) -> None:
    lab = build(END_S)
    offsets_ns = {**lab.clock_offsets_ns, "white": lab.clock_offsets_ns["white"] + 45_000_000}
    said = watch(model, drive_messages(replace(lab, clock_offsets_ns=offsets_ns), [KNOCK], 0.2))
    # Only differences of clocks are visible: they are those from the mean of the three cameras.
    late_ms = {str(e.camera): int(e.text.split(" ms ")[0].split()[-1]) for _, e in said.of_kind(CLOCK_JUMPED)}
    assert late_ms == pytest.approx({"black": -15, "red": -15, "white": 30}, abs=2.5)
    assert [pose.camera for _, pose in said.poses if pose.state == MOVED] == ["white"]
    assert said.of_kind(CAMERA_MOVED)[0][0] > KNOCK_S


def test_raised_marker_is_named_and_no_camera(model: Model) -> None:
    lab = build(END_S)
    raised = replace(lab, robot_heights_m={**lab.robot_heights_m, 2: lab.robot_heights_m[2] + 0.008})
    pairs = zip(drive_messages(lab), drive_messages(raised), strict=True)
    knock_ns = EPOCH_NS + (KNOCK_S + 1) * NS_PER_S
    said = watch(model, (one if one.log_time_ns < knock_ns else other for one, other in pairs))
    assert {event.marker_id for _, event in said.of_kind(MARKER_MOVED)} == {2}
    assert all(pose.state not in (MOVED, REPAIRED) for _, pose in said.poses)


def test_person_over_half_of_a_view_is_no_event(model: Model) -> None:
    def cover(message: Message) -> Message:
        frame, after_s = message.payload, (message.log_time_ns - EPOCH_NS) / NS_PER_S
        if not isinstance(frame, Markers) or message.camera != "red" or not 20 < after_s < 50:
            return message
        seen = tuple(one for one in frame.markers if one.corners_px[:, 0].mean() > frame.width / 2)
        return replace(message, payload=replace(frame, markers=seen))

    messages = drive_messages(build(END_S), (), 0.2)
    assert watch(model, map(cover, messages)) == Watched([], [])


def test_unseen_motion_is_in_a_narrow_covariance(model: Model) -> None:
    knock = replace(KNOCK, camera="red")
    messages = drive_messages(build(KNOCK_S + 76), [knock])
    said = watch(model, (one for one in messages if one.camera != "white"))
    camera, pose = restore_joint(model)["red"], said.poses[-1][1]
    assert pose.state == PARTLY
    known = replace(camera, camera_from_world=pose.camera_from_world, origin_m=pose.position_m)
    motion = np.concatenate([knock.turn_rad, knock.shift_m])
    misses = find_motion(move_camera(camera, motion), known)
    assert misses @ np.linalg.solve(pose.covariance, misses) < 22.5  # 0.1 % of chi2 with 6
    assert np.sqrt(pose.covariance.diagonal()).max() < 0.015


def test_clock_that_jumps_is_named_and_no_camera(model: Model) -> None:
    said = watch(model, drive_messages(build(END_S), [Disturbance("red", KNOCK_S, clock_s=0.03)]))
    ((_, event),) = said.of_kind(CLOCK_JUMPED)
    assert event.camera == "red"
    assert float(event.text.split(" by ")[1].split()[0]) == pytest.approx(30, abs=1.5)
    assert not said.of_kind(CAMERA_REPAIRED)


def test_changed_lens_is_not_repaired(model: Model) -> None:
    zoomed = drive_messages(build(KNOCK_S + 70), [Disturbance("red", KNOCK_S, zoom=0.006)])
    said = watch(model, zoomed)
    assert {pose.camera for _, pose in said.poses} == {"red"}
    assert said.poses[-1][1].state == MOVED
    assert said.events[-1][0] < KNOCK_S + 36
    assert "lens" in said.events[-1][1].text


def test_other_camera_at_a_place_is_named(model: Model) -> None:
    other = Disturbance("black", KNOCK_S, (0.05, 0.03, 0.3), (0.03, 0.02, 0.01))
    ((_, event),) = watch(model, drive_messages(build(END_S), [other])).events
    assert "camera black was turned far, zoomed, or exchanged" in event.text


def test_wrong_corners_of_one_marker_accuse_no_camera(model: Model) -> None:
    """A camera sees one robot for 5 s, at the edge of its image: its corners are wrong by 2 px."""

    def spoil(message: Message) -> Message:
        since_s = (message.log_time_ns - EPOCH_NS) / NS_PER_S
        if message.camera != "red" or not 55 < since_s < 60:
            return message
        wrong_px = 2.0 * np.array([[1, 1], [-1, 1], [1, -1], [-1, 1]])
        seen = [one for one in message.payload.markers if one.id == 3]
        spoilt = tuple(replace(one, corners_px=one.corners_px + wrong_px) for one in seen)
        return replace(message, payload=replace(message.payload, markers=spoilt))

    said = watch(model, map(spoil, drive_messages(build(END_S))))
    assert not [event for _, event in said.of_kind(CAMERA_MOVED) if "turned far" in event.text]


def test_reference_markers_alone_repair_a_camera(model: Model) -> None:
    fixed = {marker_id: lying(*place) for marker_id, place in REFERENCES.items()}
    messages = drive_messages(build(END_S), [KNOCK], 0.0, fixed, list(REFERENCES))
    said = watch(model, keep_markers(messages, REFERENCES))
    repaired = [pose for _, pose in said.poses if pose.state == REPAIRED]
    expected = restore_joint(model)["white"].origin_m + KNOCK.shift_m
    assert np.linalg.norm(repaired[-1].position_m - expected) < 0.0005


def test_reference_markers_at_two_frames_per_second_show_a_knock(model: Model) -> None:
    others = {number: lying(*place) for number, place in REFERENCES.items()}
    messages = keep_markers(drive_messages(build(END_S), [KNOCK], 0.0, others, [*REFERENCES]), REFERENCES)
    slow = (
        one
        for one in messages
        if not isinstance(one.payload, Markers) or one.publish_time_ns // 10**8 % 5 == 0
    )
    said = watch(model, slow)
    assert {pose.camera for _, pose in said.poses if pose.state == MOVED} == {"white"}


def test_moved_reference_marker_is_named_and_no_camera(model: Model) -> None:
    fixed = {marker_id: lying(*place) for marker_id, place in REFERENCES.items()}
    fixed[96] = lying(2.4, 2.4, KNOCK_S)
    said = watch(model, drive_messages(build(END_S), (), 0.0, fixed, list(fixed)))
    ((_, event),) = said.events
    assert (event.kind, event.marker_id) == (MARKER_MOVED, 96)


@pytest.fixture(scope="module")
def log(calibration: list[Message], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the log of a drive with a knock, and a calibration beside it."""
    folder = tmp_path_factory.mktemp("watch")
    write_log(folder / "calibration.mcap", calibration)
    api.replay(folder / "calibration.mcap", models=["joint"], until="fit")
    lab = build(END_S)

    def messages() -> Iterator[Message]:
        for message in drive_messages(lab, [KNOCK]):
            yield message
            if message.log_time_ns == EPOCH_NS:
                for name, lens in lab.calibrations.items():
                    calibrated = replace(lens, timestamp=EPOCH_NS)
                    yield Message(calibration_topic(name), EPOCH_NS, EPOCH_NS, calibrated, name)
        time_ns, end_ns = message.publish_time_ns, message.log_time_ns + 1
        run = Run(time_ns, MARKERS_RUN, IMPORTED, {"format": "geometric_lab"})
        yield Message(RECORD.topic_of(MARKERS_RUN), end_ns, time_ns, run)

    write_log(folder / "drive.mcap", messages())
    return folder / "drive.mcap"


def test_positions_of_a_moved_camera_are_uncertain_until_its_repair(log: Path, tmp_path: Path) -> None:
    result = tmp_path / "result.mcap"
    api.replay(log, model_from=log.with_name("calibration.mcap"), models=["joint"], output=result)
    with Session([log, result]) as session:
        frames: list[Positions] = session.payloads([POSITIONS.topic_of("joint", "white")])
    knock_ns = EPOCH_NS + (KNOCK_S + 1) * NS_PER_S
    before = [p for f in frames if f.timestamp < knock_ns for p in f.positions]
    after = [p for f in frames if f.timestamp > knock_ns + 6 * NS_PER_S for p in f.positions]
    assert all(position.inside for position in before)
    assert not any(position.inside for position in after)
    variances_m2 = [np.trace(p.covariance_m2[:2, :2]) for p in after if p.covariance_m2 is not None]
    assert np.sqrt(np.median(variances_m2)) > 0.006


def test_afterwards_positions_are_right_from_the_knock_on(log: Path, ipsys: Ipsys, tmp_path: Path) -> None:
    result = tmp_path / "result.mcap"
    given = ("--model-from", log.with_name("calibration.mcap"), "--model", "joint", "-o", result)
    ipsys("replay", log, *given, "--self-calibrate")
    with Session([log, result]) as session:
        poses = [one for p in session.payloads([CAMERA_POSES.topic_of("joint")]) for one in p.poses]
        events = session.payloads([RUN_EVENTS.topic_of("joint")])
        frames: list[Positions] = session.payloads([POSITIONS.topic_of("joint", "white")])
        (run,) = [one for one in session.runs() if one.stage == "watch"]
        assert session.payloads([MODEL.topic_of("joint")])
    assert run.parameters["self_calibrate"] == "afterwards"
    assert [pose.state for pose in poses] == [MOVED, REPAIRED]
    assert {event.kind for event in events} == {CAMERA_MOVED, CAMERA_REPAIRED}
    since_ns = EPOCH_NS + (KNOCK_S + 1) * NS_PER_S + 2 * NS_PER_S
    assert all(p.inside for frame in frames if frame.timestamp > since_ns for p in frame.positions)
    assert ipsys("verify", log, result).out.endswith("the replay is identical to the log\n")


def test_self_calibration_of_another_model_is_one_line(ipsys: Ipsys, lab_log: Path, tmp_path: Path) -> None:
    own = tmp_path / "lab.mcap"
    own.write_bytes(lab_log.read_bytes())
    done = ipsys("replay", own, "--model", "poly", "--self-calibrate")
    assert done.code == 1
    assert "--self-calibrate: poly has no camera poses" in done.err
    assert "Traceback" not in done.err


def test_drift_names_the_knock_and_appends_the_new_pose(log: Path, ipsys: Ipsys, tmp_path: Path) -> None:
    drive = tmp_path / "drive.mcap"
    drive.write_bytes(log.read_bytes())
    figure = tmp_path / "drift.png"
    shown = ipsys(
        *("drift", drive, "--model-from", log.with_name("calibration.mcap"), "--fix", "--plot", figure)
    ).out
    assert "Camera white moved" in shown
    assert "Camera red" not in shown
    assert figure.stat().st_size > 10_000
    with Session([drive]) as session, Session([log.with_name("calibration.mcap")]) as calibrated:
        (mended,) = session.payloads([MODEL.topic_of("joint_mended")])
        (fitted,) = calibrated.payloads([MODEL.topic_of("joint")])
    moved_m = restore_joint(mended)["white"].origin_m - restore_joint(fitted)["white"].origin_m
    assert np.linalg.norm(moved_m - KNOCK.shift_m) < 0.0006
