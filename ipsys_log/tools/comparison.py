"""Comparison of a robot's own estimates with its tracks, which are the ground truth."""

import hashlib
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ipsys_log.engine.output import append_run, open_target
from ipsys_log.engine.provenance import fingerprint, read_channels
from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import IMPORTED, Array, Message, Rig, RigBody, Run, Track, Tracks
from ipsys_log.messages.channels import ESTIMATE, TRACKS
from ipsys_log.models.tracking.track_messages import gather_rows
from ipsys_log.statistics.accuracy import root_mean_square_m
from ipsys_log.statistics.estimate_scores import EstimateFrame, EstimateScore, score_estimate
from ipsys_log.statistics.ground_truth import gather_paths
from ipsys_log.statistics.path_alignment import PathAlignment
from ipsys_log.tools.estimates import Body, CompareOptions, TrackedRobots, align_body, read_estimates
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import pose_from_rpy, rpy_from_rotation
from ipsys_log.vision.poses import make_pose, rotation, rotation_vector

# Poses of an estimate this long before and after the tracks are stored, too.
_MARGIN_NS = NS_PER_S
_LONGEST_NAME = 40
# Parameters that are no numbers.
_TEXTS = {*("format", "file", "file_sha256", "body", "robot", "align", "axes", "remarks", "with_scale")}


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """An estimate and its score.

    Attributes
    ----------
    record : its run, with clock, frames, pivot and file in its parameters.
    messages : the poses of the body in the clock and the coordinates of the lab, which the run stores.
    """

    record: Run
    messages: tuple[Message, ...]
    score: EstimateScore

    @property
    def is_stored(self) -> bool:
        """Return whether the log has the run: its record then has its outputs."""
        return bool(self.record.outputs)

    @property
    def robot(self) -> str:
        return self.record.parameters["robot"]

    @property
    def alignment(self) -> str:
        """The alignment of the stated error: with a scale if it was asked for, otherwise that of --align."""
        if self.with_scale:
            return "sim3"
        return {"2d": "yaw", "3d": "se3"}.get(self.record.parameters["align"], "none")

    @property
    def with_scale(self) -> bool:
        """Return whether the alignment has a scale."""
        return "with_scale" in self.record.parameters

    def summary(self) -> dict[str, Any]:
        """Return the parameters of the run, and the scores that are one number, in SI units."""
        score = self.score
        numbers: dict[str, Any] = {
            name: text if name in _TEXTS else number_in(self.record, name)
            for name, text in self.record.parameters.items()
        }
        row = score.after(self.alignment)
        numbers |= {"stated_alignment": row.alignment, "ate_m": root_mean_square_m(row.errors.absolute_3d)}
        numbers |= {
            "poses": len(score.times_ns),
            "tracks_rms_m": score.tracks_m,
            **score.coverage._asdict(),
            "nees": score.nees,
        }
        if score.drift is not None:
            numbers["drift_share"] = float(score.drift.errors_m.mean()) / score.drift.delta
            numbers["drift_distance_m"] = score.drift.delta
        known = {name: value for name, value in numbers.items() if value is not None}
        return {"run": self.record.run, "tracks_run": ", ".join(self.record.input_runs), **known}


def number_in(record: Run, name: str) -> float:
    """Return a parameter; a record leaves out those that neither were estimated nor change a pose."""
    text = record.parameters.get(name, "1" if name == "scale" else "0")
    try:
        return float(text)
    except ValueError:
        raise IpsysError(f"run {record.run}: {name} is {text[:40]!r}, no number; compare again") from None


def _vector(record: Run, name: str) -> Array:
    """Return the three parameters of a name such as ``pivot_{}_m``."""
    return np.array([number_in(record, name.format(axis)) for axis in "xyz"])


def move_pivot(rig: Rig, found: Comparison, tracked: Rig | None) -> Rig:
    """Return a rig whose tracks of a robot are those of the body of an estimate.

    Parameters
    ----------
    rig : the rig to change.
    found : the comparison, with the pivot and the turn of the body relative to the tracks.
    tracked : the rig of these tracks.

    Raises
    ------
    IpsysError
        The drive does not determine the pivot, the rig does not have the robot, or it has another pivot than
        the tracks.
    """
    robot, record = found.robot, found.record
    if not {"pivot_x_m", "pivot_y_m"} & record.parameters.keys():
        raise IpsysError(
            f"the drive of {robot} does not determine its pivot; drive curves at different speeds, or give "
            "--pivot"
        )
    heights_m = rig.robot_heights_m()
    if robot not in heights_m:
        raise IpsysError(f"the rig has no robot {robot}; name it in [[markers]]")
    bodies = {body.robot: body for body in rig.bodies}
    own = bodies.get(robot, RigBody(robot, level=heights_m[robot] is not None))
    used = next((one for one in tracked.bodies if one.robot == robot), None) if tracked else None
    old = pose_from_rpy(own.pivot_m, own.pivot_rpy_rad)
    if not np.allclose(old, pose_from_rpy(used.pivot_m, used.pivot_rpy_rad) if used else np.eye(4)):
        raise IpsysError(
            f"the tracks of {robot} have another pivot than the rig; replay the log with it first"
        )
    turn = rotation(np.array([0.0, 0.0, number_in(record, "body_turn_rad")]))
    new = old @ make_pose(turn, _vector(record, "pivot_{}_m"))
    pivot = tuple(round(one, 6) for one in new[:3, 3].tolist())
    rpy_rad = tuple(round(one, 6) for one in rpy_from_rotation(new[:3, :3]))
    bodies[robot] = replace(own, pivot_m=pivot, pivot_rpy_rad=rpy_rad)
    return replace(rig, bodies=tuple(bodies.values()))


def compare(
    session: Session,
    files: Sequence[Path],
    options: CompareOptions,
    say: Callable[[str], None] = lambda line: None,
    progress: Progress = lambda step, done, total: None,
) -> list[Comparison]:
    """Align estimates with the tracks of their robots, each alone, and score them. Nothing is written.

    Parameters
    ----------
    say : called with what was understood of each file.

    Raises
    ------
    IpsysError
        A file cannot be read, the log has no tracks, or an estimate does not fit the tracks of a robot.
    """
    tracked = TrackedRobots(session, options.run)
    bodies = read_estimates(files, tracked, options, say, progress)
    aligned = [(body, *align_body(body, tracked, options.known)) for body in bodies]
    taken, number = set(session.run_names()), max((run.number for run in session.runs()), default=0)
    found = []
    for body, robot, alignment in aligned:
        record = _record(body, robot, alignment, options, session, tracked)
        stored = _stored_run(session, record)
        if stored is not None:
            found.append(_scored(stored, _poses(session, stored), tracked))
            continue
        number += 1
        record = replace(record, run=_free_name(body.file, taken), number=number)
        taken.add(record.run)
        messages = tuple(_messages(record, body, alignment, tracked))
        record = replace(record, timestamp=messages[-1].log_time_ns)
        found.append(_scored(record, messages, tracked))
    return found


def append_comparisons(
    logs: Sequence[LogLocation], output: Path | None, comparisons: Sequence[Comparison]
) -> Path | None:
    """Append the runs of comparisons that the log does not have yet; return the log that got them."""
    new = [one for one in comparisons if not one.is_stored]
    if not new:
        return None
    with open_target(logs, output) as (_, target):
        for one in new:
            append_run(target, one.record, one.record.timestamp, lambda one=one: one.messages, {})  # type: ignore[misc]
    return output or target


def read_comparisons(session: Session, run: str | None = None) -> list[Comparison]:
    """Return the comparisons that a log stores, computed again from their poses and the tracks.

    ``run`` is the run with the tracks; None: those of each comparison, or the newest ones if the log lacks
    them.
    """
    found, tracked = [], dict[str | None, TrackedRobots]()
    for record in session.runs():
        is_import = record.stage == IMPORTED and {"robot", "file", "align"} <= record.parameters.keys()
        if is_import and session.topics(ESTIMATE, record.run):
            name = run or next((one for one in record.input_runs if session.topics(TRACKS, one)), None)
            if name not in tracked:
                tracked[name] = TrackedRobots(session, name)
            found.append(_scored(record, _poses(session, record), tracked[name]))
    return found


def _poses(session: Session, record: Run) -> tuple[Message, ...]:
    return tuple(session.messages(session.topics(ESTIMATE, record.run)))


def _scored(record: Run, messages: tuple[Message, ...], tracked: TrackedRobots) -> Comparison:
    found = Comparison(record, messages, None)  # type: ignore[arg-type]
    turn = rotation(_vector(record, "rotation_{}_rad"))
    frame = EstimateFrame(
        # The turn of the x axis; the rest of the rotation levels the coordinates, such as y up, before it.
        float(np.arctan2(turn[1, 0], turn[0, 0])),
        _vector(record, "translation_{}_m"),
        number_in(record, "scale") if found.with_scale else 1.0,
        _vector(record, "pivot_{}_m"),
        number_in(record, "body_turn_rad"),
    )
    if not np.isfinite([frame.yaw_rad, *frame.shift_m, frame.scale, *frame.pivot_m, frame.turn_rad]).all():
        raise IpsysError(f"run {record.run}: its record has a value that is not finite; compare again")
    estimate, tracks = gather_rows(messages, found.robot)[0], tracked.rows(found.robot)
    path, rotations = tracked.paths[found.robot], None
    own = next((one for one in gather_paths(messages).values() if one.robot == found.robot), path)
    if path.rotations_rad is not None and own.rotations_rad is not None:
        rotations = own.axes_at(estimate.times_ns), path.axes_at(estimate.times_ns)
    score = score_estimate(estimate, tracks, frame, found.with_scale, record.parameters["file"], rotations)
    return replace(found, score=score)


def _record(
    body: Body,
    robot: str,
    found: PathAlignment,
    options: CompareOptions,
    session: Session,
    tracked: TrackedRobots,
) -> Run:
    """Return the record of a comparison, without its name, its number and its outputs."""
    known = options.known
    texts = {
        "format": body.file.suffix.lower().removeprefix(".") or "bag",
        "file": body.file.name,
        "file_sha256": _hash(body.file),
        "body": body.trajectory.name,
        "robot": robot,
        "align": known.align,
        "with_scale": "yes" if known.with_scale else "",
    }
    parameters = {name: text for name, text in texts.items() if text} | found.record_parameters()
    inputs = read_channels(session, tracked.topics)
    return Run(0, "", IMPORTED, parameters, fingerprint(), input_runs=(tracked.run,), inputs=inputs)


def _hash(file: Path) -> str:
    """Return the SHA-256 of a file; for the folder of a bag, that of the hashes of its files."""
    hashes = []
    for path in sorted(file.iterdir()) if file.is_dir() else [file]:
        with path.open("rb") as opened:
            hashes.append(hashlib.file_digest(opened, "sha256"))
    if not file.is_dir():
        return hashes[0].hexdigest()
    return hashlib.sha256(b"".join(one.digest() for one in hashes)).hexdigest()


def _stored_run(session: Session, record: Run) -> Run | None:
    """Return the run with the same estimate, alignment and tracks, if the log has it."""
    same = [
        run
        for run in session.runs()
        if (run.stage, run.parameters, run.inputs) == (record.stage, record.parameters, record.inputs)
    ]
    return same[-1] if same else None


def _free_name(file: Path, taken: set[str]) -> str:
    """Return the name of a run by its file, such as ``odom``, ``odom_2`` if it is taken."""
    name = re.sub(r"[^a-z0-9]+", "_", file.stem.lower()).strip("_")[:_LONGEST_NAME] or "estimate"
    base = name if name[0].isalpha() else f"estimate_{name}"
    return next(one for one in (base, *(f"{base}_{n}" for n in range(2, len(taken) + 3))) if one not in taken)


def _messages(record: Run, body: Body, alignment: PathAlignment, tracked: TrackedRobots) -> Iterator[Message]:
    """Yield the poses of a body during the tracks, in the clock and the coordinates of the lab.

    The rows that the alignment leaves out, such as jumps, are here: they are errors of the estimate.
    """
    robot, topic = record.parameters["robot"], ESTIMATE.topic_of(record.run)
    path = tracked.paths[robot]
    lab, track_ns = alignment.lab_poses(body.trajectory), path.positions.times_ns
    within = (lab.times_ns >= track_ns[0] - _MARGIN_NS) & (lab.times_ns <= track_ns[-1] + _MARGIN_NS)
    if not within.any():
        raise IpsysError(
            f"{body.where}: does not overlap in time with the tracks of {robot}; check --time-offset"
        )
    axes, turn = lab.axes, alignment.motion.rotation
    headings_rad = np.arctan2(axes[:, 1, 0], axes[:, 0, 0])
    # A level robot has headings alone, and so has an estimate on the floor.
    has_tilt = path.rotations_rad is not None and (np.abs(body.trajectory.quaternions[:, :2]) > 0).any()
    for row in np.flatnonzero(within).tolist():
        x_m, y_m, z_m = lab.points_m[row].tolist()
        heading_rad = float(headings_rad[row]) if np.isfinite(headings_rad[row]) else None
        track = Track(robot, tracked.markers[robot], x_m, y_m, z_m, heading_rad)
        if has_tilt and heading_rad is not None:
            track = replace(track, rotation_rad=rotation_vector(axes[row]))
        covariance = None if lab.covariances is None else _known(lab.covariances[row])
        if covariance is not None:
            sigma_rad = float(np.sqrt(max(covariance[5, 5], 0.0)))
            track = replace(
                track, covariance_m2=turn @ covariance[:3, :3] @ turn.T, heading_sigma_rad=sigma_rad
            )
        time_ns = int(lab.times_ns[row])
        yield Message(topic, time_ns, time_ns, Tracks(time_ns, (track,)))


def _known(covariance: Array) -> Array | None:
    """Return a covariance (6, 6) if it states an error on the floor; drivers write zeros for unknown ones."""
    diagonal = covariance[[0, 1], [0, 1]]
    return covariance if np.isfinite(covariance).all() and (diagonal > 0).all() else None
