"""Faults of the scale of the tape: see ``contradictions.py``."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from fault_trials import Fault, Outcome, Trial, cases_folder

from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Markers, Measurement, Message, Positions, Rig, Tracks
from ipsys_log.messages.channels import POSITIONS
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.session import simulate_session

__all__ = ["FAULTS"]

_CASE = "joint/tape_scale_0.3_percent_8_points"
_LAB = LabSettings(rate_hz=10.0, drive_s=60.0, markers=1)
# The region of 95 % of a normal distribution in two dimensions.
_INSIDE = 5.991
# True positions (x, y) in m by camera and time.
Truth = dict[tuple[str, int], tuple[float, float]]


def _case(trial: Trial) -> Outcome:
    """Calibrate with the tape of the folder of faulty inputs, and locate still robots."""
    lab, still = trial.folder / "lab.mcap", trial.folder / "still.mcap"
    shutil.copy(cases_folder() / f"{_CASE}.mcap", lab)
    shutil.copy(cases_folder() / f"{_CASE}_eval.mcap", still)
    with (cases_folder() / f"{_CASE}_truth.csv").open(encoding="utf-8") as rows:
        truth = {
            (row["camera"], int(row["time_ns"])): (float(row["x_m"]), float(row["y_m"]))
            for row in csv.DictReader(rows)
        }
    return _answer(trial, lab, still, truth)


def _answer(trial: Trial, lab: Path, still: Path, truth: Truth) -> Outcome:
    text = trial.ipsys("calibrate-lab", lab, "-o", "model.mcap")
    trial.ipsys("locate", still, "-o", "located.mcap", "--model-from", "model.mcap")
    errors_m, inside = _compare(trial.folder / "located.mcap", truth)
    named = any(line.strip().startswith("tape:") for line in text.splitlines())
    verdict = text.splitlines()[0].split(":")[0] if text else ""
    return Outcome(named, 1000 * float(np.median(errors_m)), float(np.mean(inside)), verdict)


def _compare(log: Path, truth: Truth) -> tuple[list[float], list[bool]]:
    """Return the error of each position, and whether it is in its region."""
    errors_m, inside = [], []
    with Session([log]) as session:
        topics = [topic for run in session.runs() for topic in session.topics(POSITIONS, run.run)]
        for message in session.messages(dict.fromkeys(topics)):
            assert isinstance(message.payload, Positions)
            known = truth.get((str(message.camera), message.publish_time_ns))
            for position in message.payload.positions:
                if known is None or position.covariance_m2 is None:
                    continue
                offset_m = np.array([position.x_m - known[0], position.y_m - known[1]])
                covariance_m2 = position.covariance_m2[:2, :2]
                errors_m.append(float(np.hypot(*offset_m)))
                inside.append(bool(offset_m @ np.linalg.solve(covariance_m2, offset_m) <= _INSIDE))
    return errors_m, inside


def _scaled(messages: Iterator[Message], scale: float, same_tape: bool) -> Iterator[Message]:
    """Yield messages whose tape reads too long; with ``same_tape``, it measured the reference points, too."""
    for message in messages:
        payload = message.payload
        if isinstance(payload, Measurement):
            distances = tuple(replace(d, distance_m=d.distance_m * scale) for d in payload.distances)
            payload = replace(payload, distances=distances)
        elif isinstance(payload, Rig) and same_tape:
            payload = _remeasured(payload, scale)
        yield replace(message, payload=payload)


def _remeasured(rig: Rig, scale: float) -> Rig:
    """Return the rig with reference points that are too far from their middle."""
    points = rig.reference_points
    x_m, y_m = np.mean([(point.x_m, point.y_m) for point in points], axis=0).tolist()
    return replace(
        rig,
        reference_points=tuple(
            replace(point, x_m=x_m + scale * (point.x_m - x_m), y_m=y_m + scale * (point.y_m - y_m))
            for point in points
        ),
    )


def _random(trial: Trial, scale: float, same_tape: bool = False) -> Outcome:
    """Calibrate a random lab with 8 points and a drive, and locate the robot of the drive."""
    lab = build_lab(GeometricSettings(lab=replace(_LAB, seed=trial.seed), points=8))
    messages = list(simulate_session(lab))
    log, still = trial.folder / "lab.mcap", trial.folder / "still.mcap"
    write_log(log, _scaled(iter(messages), scale, same_tape))
    end_ns = max(m.log_time_ns for m in messages if isinstance(m.payload, Measurement))
    write_log(
        still, (m for m in messages if not (isinstance(m.payload, Measurement) or _is_early(m, end_ns)))
    )
    places_m = {
        m.publish_time_ns: (m.payload.tracks[0].x_m, m.payload.tracks[0].y_m)
        for m in messages
        if isinstance(m.payload, Tracks) and m.payload.tracks
    }
    truth = {(camera.name, time_ns): xy for camera in lab.cameras for time_ns, xy in places_m.items()}
    return _answer(trial, log, still, truth)


def _is_early(message: Message, end_ns: int) -> bool:
    """Return whether a message shows markers at the calibration points."""
    return isinstance(message.payload, Markers) and message.log_time_ns <= end_ns


def _drawn(trial: Trial, same_tape: bool) -> Outcome:
    """Draw the scale of the tape with its standard deviation of 0.1 %."""
    scale = 1 + 0.001 * float(np.random.default_rng([trial.seed, 33]).standard_normal())
    return _random(trial, scale, same_tape)


def _evaluated(model: str) -> Callable[[Trial], Outcome]:
    """Return a trial of 30 points: the stated interval of the error after that of the tape has the truth."""

    def try_once(trial: Trial) -> Outcome:
        lab = build_lab(
            GeometricSettings(lab=LabSettings(rate_hz=10.0, drive_s=0.0, seed=trial.seed), points=30)
        )
        write_log(trial.folder / "lab.mcap", simulate_session(lab))
        text = trial.ipsys("evaluate", "lab.mcap", "--model", model, "--json")
        answer, _ = json.JSONDecoder().raw_decode(text, text.index("{"))
        stated, errors = answer["answer"], answer["models"][model]["pooled"]["cross_validation"]
        true_m = errors["truth"]["3d"]["mean_m"]
        low_m, high_m = (
            stated.get(f"remaining_{end}_m", errors["3d"][f"mean_{end}_m"]) for end in ("low", "high")
        )
        return Outcome(bool(low_m <= true_m <= high_m), 1000 * true_m)

    return try_once


FAULTS: Sequence[Fault] = (
    Fault("tape 0.3 % too long, case", _case),
    Fault("tape 0.3 % too long", lambda trial: _random(trial, 1.003), is_random=True),
    Fault("tape 1 % too short", lambda trial: _random(trial, 0.99), is_random=True),
    Fault("tape of 0.1 % (honest)", lambda trial: _drawn(trial, False), is_random=True),
    Fault("tape of 0.1 %, also for A and B (honest)", lambda trial: _drawn(trial, True), is_random=True),
    Fault("evaluate: interval has the true error, best", _evaluated("best"), is_random=True),
    Fault("evaluate: interval has the true error, joint", _evaluated("joint"), is_random=True),
)
