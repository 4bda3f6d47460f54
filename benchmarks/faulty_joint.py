"""Faults of sides, points and cameras that contradict a joint calibration: see ``contradictions.py``."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from fault_trials import Fault, Outcome, Trial, cases_folder
from geometric_labs import sight
from numpy.typing import NDArray

from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    CameraCalibration,
    Marker,
    Markers,
    Measurement,
    Message,
    Position,
    Positions,
    Rig,
    Run,
)
from ipsys_log.messages.channels import MARKERS, POSITIONS
from ipsys_log.units import MM_PER_M, NS_PER_S
from ipsys_log.vision.poses import make_pose, rotation
from ipsys_log.vision.trilateration import multilaterate
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import MARKERS_RUN, geometric_rig, simulate_session

__all__ = ["FAULTS"]

Array = NDArray[np.float64]
# True positions (2,) of markers by camera and time.
_Truth = dict[tuple[str, int], Array]

# 95 % of the errors in two dimensions have less than this chi2.
_REGION_95 = 5.99
_EVALUATION_NS = 3600 * NS_PER_S
_NODES = 150
_LAB = LabSettings(rate_hz=10.0, drive_s=45.0, markers=1, row_time_ns=31_000)
_WRONG_ROW_NS = 15_000
# From a lab to the lab as it is later, the messages of the session, and a text that the output must have.
_Fault = Callable[[GeometricLab, np.random.Generator], tuple[GeometricLab, Iterable[Message], str]]


def _lab(trial: Trial, points: int) -> GeometricLab:
    """Return a lab with the usual errors: print, height, floor, clocks, and tilts of the robot."""
    settings = GeometricSettings(
        lab=replace(_LAB, seed=trial.seed),
        points=points,
        floor_rms_m=0.0005,
        wobble_deg=0.2,
        marker_scale_sigma=0.001,
        robot_height_sigma_m=0.0005,
    )
    return build_lab(settings)


def _case(name: str, words: Sequence[str]) -> Callable[[Trial], Outcome]:
    """Return the trial of a stored case; its output must have one of the words."""

    def try_once(trial: Trial) -> Outcome:
        folder = cases_folder() / "joint"
        for suffix in ("", "_eval"):
            shutil.copy(folder / f"{name}{suffix}.mcap", trial.folder / f"lab{suffix}.mcap")
        with (folder / f"{name}_truth.csv").open() as lines:
            truth = {
                (row["camera"], int(row["time_ns"])): np.array([float(row["x_m"]), float(row["y_m"])])
                for row in csv.DictReader(lines)
            }
        return _answer(trial, truth, words)

    return try_once


def _fits_with_more_points(trial: Trial) -> Outcome:
    """Fit a stored lab, which can be fitted without the two points that were added on a line."""
    log = shutil.copy(cases_folder() / "joint" / "points_on_a_line_after_2_more.mcap", trial.folder)
    answer = trial.ipsys("calibrate-lab", log)
    is_refused = "ipsys:" in answer
    return Outcome(not is_refused, figure="refused" if is_refused else "fitted")


def _random(points: int, fault: _Fault) -> Callable[[Trial], Outcome]:
    """Return the trial of a random lab with a fault.

    The fault gives the lab as it is later, the messages, and a text that the output must have.
    """

    def try_once(trial: Trial) -> Outcome:
        rng = np.random.default_rng([trial.seed, 33])
        later, messages, word = fault(_lab(trial, points), rng)
        messages = list(messages)
        write_log(trial.folder / "lab.mcap", messages)
        head = [m for m in messages if isinstance(m.payload, Rig | CameraCalibration)]
        truth: _Truth = {}
        write_log(trial.folder / "lab_eval.mcap", [*head, *_standing(later, messages, rng, truth)])
        return _answer(trial, truth, [word])

    return try_once


def _standing(
    lab: GeometricLab, messages: Sequence[Message], rng: np.random.Generator, truth: _Truth
) -> Iterator[Message]:
    """Yield sightings of a robot that stands at random places, an hour later; fill in their truth."""
    lab_settings = lab.settings.lab
    rig = next(m.payload for m in messages if isinstance(m.payload, Rig))
    row_ns = {camera.name: camera.row_time_ns for camera in rig.cameras}
    poses = np.column_stack(
        [
            rng.uniform(0.3, np.subtract(lab_settings.floor_m, 0.3), (_NODES, 2)),
            np.full(_NODES, lab.robot_heights_m[0]),
            rng.uniform(-np.pi, np.pi, _NODES),
        ]
    )
    log_ns = messages[-1].log_time_ns + _EVALUATION_NS
    for camera in sight(lab, poses, rng):
        assert camera.covariances_px2 is not None
        columns = camera.truth_m, camera.corners_px, camera.covariances_px2
        for true_m, corners_px, covariance_px2 in zip(*columns, strict=True):
            log_ns += NS_PER_S
            truth[camera.camera, log_ns] = true_m
            offset_ns = round(float(corners_px[:, 1].mean()) * (row_ns[camera.camera] or 0))
            marker = Marker(0, corners_px, covariance_px2, offset_ns)
            frame = Markers(log_ns, (marker,), lab_settings.width, lab_settings.height)
            topic = MARKERS.topic_of(MARKERS_RUN, camera.camera)
            yield Message(topic, log_ns, log_ns, frame, camera.camera)
    run = next(m for m in messages if isinstance(m.payload, Run))
    yield replace(run, log_time_ns=log_ns + 1, publish_time_ns=log_ns)


def _with_measurements(
    messages: Iterable[Message], change: Callable[[int, Measurement], Measurement]
) -> Iterator[Message]:
    number = 0
    for message in messages:
        if isinstance(message.payload, Measurement):
            yield replace(message, payload=change(number, message.payload))
            number += 1
        else:
            yield message


def _flip(measurement: Measurement) -> Measurement:
    return replace(measurement, side="left" if measurement.side == "right" else "right")


def _exchange(measurement: Measurement) -> Measurement:
    one, two = measurement.distances
    swapped = replace(one, distance_m=two.distance_m), replace(two, distance_m=one.distance_m)
    return replace(measurement, distances=swapped)


def _wrong_points(change: Callable[[Measurement], Measurement], count: int, near_m: float = 0.15) -> _Fault:
    """Return a fault of a few points that are farther than ``near_m`` from AB, and from its middle."""

    def fault(lab: GeometricLab, rng: np.random.Generator) -> tuple[GeometricLab, Iterable[Message], str]:
        messages = list(simulate_session(lab))
        points = [m.payload for m in messages if isinstance(m.payload, Measurement)]
        reach = [_matters_m(lab, point, change) > 2 * near_m for point in points]
        chosen = rng.permutation(np.flatnonzero(reach))[:count].tolist()
        word = points[chosen[0]].id if chosen else "probable fault"

        def spoil(number: int, measurement: Measurement) -> Measurement:
            return change(measurement) if number in chosen else measurement

        return lab, _with_measurements(messages, spoil), f"{word}: it fits"

    return fault


def _matters_m(lab: GeometricLab, point: Measurement, change: Callable[[Measurement], Measurement]) -> float:
    """Return how far a change moves the place of a point."""
    rig = geometric_rig(lab)
    known = {reference.name: np.array([reference.x_m, reference.y_m]) for reference in rig.reference_points}
    places = []
    for one in (point, change(point)):
        references_m = np.array([known[d.reference] for d in one.distances])
        ranges_m = np.array([d.distance_m for d in one.distances])
        places.append(multilaterate(references_m, ranges_m, None, one.side).point_m)
    return float(np.linalg.norm(places[1] - places[0]))


def _bump(lab: GeometricLab, rng: np.random.Generator) -> tuple[GeometricLab, Iterable[Message], str]:
    """Turn any camera by 0.2 to 0.5 degrees, at any time in the middle 60 % of the session."""
    number = int(rng.integers(len(lab.cameras)))
    axis = rng.standard_normal(3)
    turn_rad = np.radians(rng.uniform(0.2, 0.5)) * axis / np.linalg.norm(axis)
    camera = lab.cameras[number]
    turned = make_pose(rotation(turn_rad), np.zeros(3)) @ camera.camera_from_world
    cameras = list(lab.cameras)
    cameras[number] = replace(camera, camera_from_world=turned)
    later = replace(lab, cameras=tuple(cameras))
    before, after = list(simulate_session(lab)), list(simulate_session(later))
    first_ns, last_ns = before[0].log_time_ns, before[-1].log_time_ns
    time_ns = first_ns + rng.uniform(0.2, 0.8) * (last_ns - first_ns)
    messages = [
        one if one.log_time_ns < time_ns or one.camera != camera.name else two
        for one, two in zip(before, after, strict=True)
    ]
    return later, messages, f"camera {camera.name}: it was moved"


def _wrong_rows(count: int) -> _Fault:
    """Return a fault of the row times in the rig of some cameras."""

    def fault(lab: GeometricLab, rng: np.random.Generator) -> tuple[GeometricLab, Iterable[Message], str]:
        names = sorted(rng.permutation([camera.name for camera in lab.cameras])[:count].tolist())

        def spoil(message: Message) -> Message:
            payload = message.payload
            if isinstance(payload, Rig):
                cameras = tuple(
                    replace(camera, row_time_ns=_WRONG_ROW_NS) if camera.name in names else camera
                    for camera in payload.cameras
                )
                return replace(message, payload=replace(payload, cameras=cameras))
            if isinstance(payload, Markers) and message.camera in names:
                markers = tuple(
                    replace(
                        m, time_offset_ns=round((m.time_offset_ns or 0) * _WRONG_ROW_NS / _LAB.row_time_ns)
                    )
                    for m in payload.markers
                )
                return replace(message, payload=replace(payload, markers=markers))
            return message

        return lab, map(spoil, simulate_session(lab)), "time between two rows is"

    return fault


def _honest(lab: GeometricLab, _: np.random.Generator) -> tuple[GeometricLab, Iterable[Message], str]:
    return lab, simulate_session(lab), "Expected 2D error"


def _answer(trial: Trial, truth: _Truth, words: Sequence[str]) -> Outcome:
    text = trial.ipsys("calibrate-lab", "lab.mcap")
    trial.ipsys("locate", "lab_eval.mcap", "--model", "joint", "--model-from", "lab.mcap")
    named = any(word in text for word in words)
    # Remarks on single sightings accuse no input.
    accused = sum(
        text.count(words) for words in ("it was moved after", "measure it again", "it fits", "row_time")
    )
    errors_mm, inside = [], []
    for camera, position in _positions(trial.folder / "lab_eval.mcap"):
        time_ns, known = position
        true_m = truth.get((camera, time_ns))
        if true_m is not None and known.inside is not False:
            assert known.covariance_m2 is not None
            away_m = np.array([known.x_m, known.y_m]) - true_m
            errors_mm.append(float(np.linalg.norm(away_m)) * MM_PER_M)
            inside.append(float(away_m @ np.linalg.solve(known.covariance_m2[:2, :2], away_m)) < _REGION_95)
    error = float(np.median(errors_mm)) if errors_mm else None
    share = float(np.mean(inside)) if inside else None
    return Outcome(named, error, share, f"{accused} accusations{', Enough' if 'Enough:' in text else ''}")


def _positions(log: Path) -> Iterator[tuple[str, tuple[int, Position]]]:
    with Session([log]) as session:
        for run in {record.run for record in session.runs()}:
            for message in session.messages(session.topics(POSITIONS, run)):
                if isinstance(message.payload, Positions):
                    for position in message.payload.positions:
                        yield str(message.camera), (message.payload.timestamp, position)


FAULTS: Sequence[Fault] = (
    Fault("side wrong, 4 points (case)", _case("side_wrong_4_points", ["p1: it fits on the other side"])),
    Fault("two more points on a line (case)", _fits_with_more_points),
    Fault(
        "camera turned midway (case)", _case("camera_c1_turned_0.3_deg_midway", ["camera c1: it was moved"])
    ),
    Fault("row time wrong (case)", _case("row_time_rig_15us_true_31us", ["time between two rows is 31"])),
    Fault("side of 1 of 4 points", _random(4, _wrong_points(_flip, 1)), is_random=True),
    Fault("side of 1 of 6 points", _random(6, _wrong_points(_flip, 1)), is_random=True),
    Fault("side of 1 of 8 points", _random(8, _wrong_points(_flip, 1)), is_random=True),
    Fault("sides of 2 of 8 points", _random(8, _wrong_points(_flip, 2)), is_random=True),
    Fault("side of any of 6 points, also near AB", _random(6, _wrong_points(_flip, 1, 0.02)), is_random=True),
    Fault("distances exchanged at 1 of 6 points", _random(6, _wrong_points(_exchange, 1)), is_random=True),
    Fault("a camera turned by 0.2 to 0.5 degrees", _random(6, _bump), is_random=True),
    Fault("row time of 1 camera", _random(6, _wrong_rows(1)), is_random=True),
    Fault("row time of 3 cameras", _random(6, _wrong_rows(3)), is_random=True),
    Fault("none: an honest lab with 6 points", _random(6, _honest), is_random=True),
)
