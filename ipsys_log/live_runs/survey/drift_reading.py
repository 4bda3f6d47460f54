"""Reading of logs for the drift of their cameras, with the checks of the input."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.joint.payload import find_motion, restore_joint
from ipsys_log.engine.mended_model import find_model
from ipsys_log.engine.provenance import newest_run
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import Array, CameraPose, CameraPoses, Event, Message, Model, Rig
from ipsys_log.messages.channels import MARKERS, RIG
from ipsys_log.messages.events import MARKER_MOVED
from ipsys_log.messages.models import MOVED, PARTLY, REPAIRED
from ipsys_log.models.table import reads_corners
from ipsys_log.plain_text import shell_words
from ipsys_log.statistics.camera_moves import (
    CameraState,
    DriftLog,
    LabDrift,
    MarkerMove,
    Move,
    find_drift,
    image_sizes,
    read_windows,
)
from ipsys_log.statistics.camera_watch import WatchCameras
from ipsys_log.statistics.deviations import STEP_NS
from ipsys_log.statistics.drift import DriftBaseline, Motion
from ipsys_log.statistics.floor_cameras import read_floor_cameras
from ipsys_log.vision.poses import PosedCamera

# States of the cameras that are noted over a log that is watched.
_STATES = 12
# A motion that shows in this time of a log may have been before it: the clocks are not known earlier.
_START_NS = 40 * STEP_NS


@dataclass(slots=True, eq=False)
class DriftReading:
    """The drift over logs, and its sources.

    Attributes
    ----------
    paths, names : the logs in order of time, and their short names; the first is the baseline.
    model : name of the model with the camera poses; ``source`` are its log and its topic.
    remarks : on logs that were left out, and others.
    since : the state that motions refer to.
    """

    drift: LabDrift
    paths: list[LogLocation]
    names: list[str]
    model: str
    source: tuple[LogLocation, str]
    remarks: list[str] = field(default_factory=list)
    since: str = ""

    def moved(self) -> dict[str, Motion]:
        """Return the motions since the baseline of the cameras that have moved at the end of the logs."""
        motions = {}
        for camera in sorted(self.drift.baselines):
            motion = next((s.motion for s in reversed(self.drift.of_camera(camera)) if s.motion), None)
            if motion is not None and motion.is_moved:
                motions[camera] = motion
        return motions


def read_drift(
    paths: Sequence[LogLocation],
    baseline: LogLocation | None = None,
    model_from: LogLocation | None = None,
    rig: Rig | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> DriftReading:
    """Find the moves of the cameras over logs.

    Parameters
    ----------
    paths : the logs, in any order.
    baseline : the log before all moves; None: the first by time.
    model_from : a log with a fitted model; None: the baseline, or else the first log with a model.
    rig : used instead of the rigs of the logs.
    progress : called with the number of logs done, and of all logs.

    Raises
    ------
    IpsysError
        No rig has reference markers, a log has no markers or is of other cameras, or no log has a model.
    """
    logs, remarks = _order(paths, baseline)
    if not any(_has_references(path, rig) for path in logs):
        return _watch_logs(logs, model_from, rig, progress, remarks)
    read = _read_logs(logs, rig, progress, remarks)
    first = read[0]
    kept = [log.path for log in read]
    model, source, cameras = _find_cameras([model_from] if model_from else kept, _start_ns(first.path))
    lengths_m = {marker.id: first.rig.length_of(marker.id) for marker in first.rig.reference_markers}
    windows = [log.windows for log in read]
    drift = find_drift(windows, cameras, lengths_m, first.rig.floor)
    seen = {camera for log in windows for window in log.windows for camera in window.corners}
    remarks += [f"camera {name}: {source[0]} has no model of it" for name in sorted(seen - set(cameras))]
    remarks += [
        f"camera {name}: sees no reference marker; it is not watched" for name in sorted(set(cameras) - seen)
    ]
    if len(read) == 1:
        remarks.append("one log shows only moves during its recording; add earlier logs")
    names = [log.name for log in windows]
    return DriftReading(drift, kept, names, model, source, remarks, names[0])


def _has_references(path: LogLocation, rig: Rig | None) -> bool:
    with Session([path]) as session:
        rigs = [rig] if rig is not None else session.payloads(session.topics(RIG))
    return any(one.reference_markers for one in rigs)


def _watch_logs(
    paths: Sequence[LogLocation],
    model_from: LogLocation | None,
    rig: Rig | None,
    progress: Callable[[int, int], None],
    remarks: list[str],
) -> DriftReading:
    """Find the moves of the cameras from robots that drive, without reference markers."""
    model, source = _find_joint_model([model_from] if model_from else paths, _start_ns(paths[0]))
    history = _History(WatchCameras(model, True), restore_joint(model))
    history.drift.baselines = {
        name: DriftBaseline(
            PosedCamera(name, one.calibration, one.camera_from_world, one.origin_m), np.empty((0, 3)), {}, {}
        )
        for name, one in history.fitted.items()
    }
    names = [path.name if [p.name for p in paths].count(path.name) == 1 else str(path) for path in paths]
    for number, (path, name) in enumerate(zip(paths, names, strict=True)):
        progress(number, len(paths))
        history.add(path, name, rig)
    progress(len(paths), len(paths))
    return DriftReading(history.drift, list(paths), names, model.name, source, remarks, "the calibration")


@dataclass(slots=True, eq=False)
class _History:
    """The watch over logs in order of time, and its findings; ``before`` are the last log and its end."""

    watch: WatchCameras
    fitted: Mapping[str, JointModel]
    drift: LabDrift = field(default_factory=LabDrift)
    before: tuple[str, int] | None = None

    def add(self, path: LogLocation, name: str, rig: Rig | None) -> None:
        """Watch the cameras in the next log."""
        poses: dict[tuple[int, str], list[CameraPose]] = {}
        with Session([path]) as session:
            first_ns = start_ns = session.start_ns
            step_ns = max((session.end_ns - start_ns) // _STATES, STEP_NS)
            for message in _marker_messages(session, rig):
                for payload in self.watch(message):
                    for pose in payload.poses if isinstance(payload, CameraPoses) else ():
                        if pose.state in (MOVED, PARTLY, REPAIRED):
                            poses.setdefault((pose.since, pose.camera), []).append(pose)
                    if isinstance(payload, Event) and payload.kind == MARKER_MOVED:
                        move = MarkerMove(int(payload.marker_id or 0), payload.timestamp, name)
                        self.drift.marker_moves.append(move)
                end_ns = message.publish_time_ns
                if end_ns > start_ns + step_ns:
                    self._note_states(name, end_ns)
                    start_ns += step_ns
        self._note_states(name, end_ns)
        for (since_ns, camera), own in sorted(poses.items()):
            if since_ns < first_ns:
                # The repair of a motion in an earlier log goes on.
                continue
            joint, covariance = self.fitted[camera], own[-1].covariance
            old, new = (
                replace(joint, origin_m=p.position_m, camera_from_world=p.camera_from_world)
                for p in (own[0], own[-1])
            )
            motion = self._motion(camera, find_motion(old, new), covariance)
            is_between = self.before is not None and since_ns < first_ns + _START_NS
            first = self.before if is_between and self.before else (name, since_ns)
            self.drift.moves.append(Move(camera, first[1], since_ns + STEP_NS, first[0], name, motion))
            before = [one for one in self.drift.of_camera(camera) if one.time_ns < since_ns]
            self.drift.states += [replace(one, log=name, time_ns=since_ns) for one in before[-1:]]
            total = self._motion(camera, find_motion(joint, new), covariance)
            self.drift.states.append(CameraState(camera, name, since_ns + STEP_NS, total))
        self.drift.states.sort(key=lambda one: one.time_ns)
        self.before = name, end_ns

    def _note_states(self, name: str, time_ns: int) -> None:
        for camera, (model, covariance) in sorted(self.watch.poses().items()):
            if self.watch.floor_of(camera) is not None:
                motion = self._motion(camera, find_motion(self.fitted[camera], model), covariance)
                self.drift.states.append(CameraState(camera, name, time_ns, motion))

    def _motion(self, camera: str, motion: Array, covariance: Array) -> Motion:
        floor = self.watch.floor_of(camera)
        assert floor is not None
        shift_m, sigma_m = floor.mean_shift(motion), floor.mean_sigma(covariance)
        evidence = float(motion @ np.linalg.solve(covariance, motion))
        return Motion(motion, covariance, shift_m, sigma_m, (), (), False, evidence, None)


def _marker_messages(session: Session, rig: Rig | None) -> Iterator[Message]:
    """Yield the rig and the markers of a log.

    Raises
    ------
    IpsysError
        The log has no markers.
    """
    run, start_ns = newest_run(session, MARKERS), session.start_ns
    if run is None:
        raise IpsysError(
            f"{session}: has no detected markers; to detect them: "
            f"ipsys replay {shell_words(*session.paths)} --until detect"
        )
    rigs = [rig] if rig is not None else session.payloads(session.topics(RIG))[:1]
    yield from (Message(RIG.topic, start_ns, start_ns, one) for one in rigs)
    later = [] if rig is not None else session.topics(RIG)
    yield from session.messages([*later, *session.topics(MARKERS, run)])


def _find_joint_model(paths: Sequence[LogLocation], until_ns: int) -> tuple[Model, tuple[LogLocation, str]]:
    """Return the newest joint model of some logs, and its source."""
    for path in paths:
        with Session([path]) as session:
            found = find_model(session, until_ns)
        if found is not None and reads_corners(found[0].name):
            return found[0], (path, found[1])
    raise IpsysError(
        f"{paths[0]}: its rig has no reference markers, and no log has the model joint; calibrate with "
        "ipsys calibrate-lab and give this log with --model-from, or add [[reference_markers]] to lab.toml"
    )


def _order(paths: Sequence[LogLocation], baseline: LogLocation | None) -> tuple[list[LogLocation], list[str]]:
    """Return the logs in order of time, the baseline first, and remarks on logs before the baseline."""
    starts_ns = {path: _start_ns(path) for path in dict.fromkeys([*paths, *([baseline] if baseline else [])])}
    first = baseline or min(starts_ns, key=starts_ns.__getitem__)
    order = sorted(starts_ns, key=lambda path: (path != first, starts_ns[path]))
    older = [path for path in order if starts_ns[path] < starts_ns[first]]
    remarks = [f"{path}: is older than the baseline; it is left out" for path in older]
    return [path for path in order if path not in older], remarks


def _read_logs(
    paths: Sequence[LogLocation], rig: Rig | None, progress: Callable[[int, int], None], remarks: list[str]
) -> "list[_Log]":
    """Return the logs with reference markers, the baseline first; add remarks on the others."""
    logs: list[_Log] = []
    for number, path in enumerate(paths):
        progress(number, len(paths))
        is_unique = [other.name for other in paths].count(path.name) == 1
        log = _read_log(path, path.name if is_unique else str(path), rig)
        if logs:
            _check_same(log, logs[0])
        if log.windows.windows:
            logs.append(log)
        elif not logs:
            raise IpsysError(f"{path}: {_describe_unseen(log.rig)}; give another log with --baseline")
        else:
            remarks.append(f"{path}: {_describe_unseen(log.rig)}; it is left out")
    progress(len(paths), len(paths))
    return logs


@dataclass(slots=True, eq=False)
class _Log:
    """A log: its rig, the size of the images by camera, and its windows."""

    path: LogLocation
    rig: Rig
    sizes_px: Mapping[str, tuple[int, int]]
    windows: DriftLog


def _start_ns(path: LogLocation) -> int:
    with Session([path]) as session:
        return session.start_ns


def _read_log(path: LogLocation, name: str, rig: Rig | None) -> _Log:
    with Session([path]) as session:
        rigs = [rig] if rig is not None else session.payloads(session.topics(RIG))
        if not rigs or not rigs[-1].reference_markers:
            raise IpsysError(
                f"{path}: its rig has no reference markers; fix markers to the floor, add "
                "[[reference_markers]] with their ids to lab.toml, and give --rig lab.toml for older logs"
            )
        run = newest_run(session, MARKERS)
        if run is None:
            raise IpsysError(
                f"{path}: has no detected markers; to detect them: "
                f"ipsys replay {shell_words(path)} --until detect"
            )
        ids = {marker.id for marker in rigs[-1].reference_markers}
        windows = DriftLog(name, read_windows(session, run, ids))
        return _Log(path, rigs[-1], image_sizes(session, run), windows)


def _describe_unseen(rig: Rig) -> str:
    ids = ", ".join(str(marker.id) for marker in rig.reference_markers)
    return f"no camera sees a reference marker ({ids}) in it, or its markers were detected with an older rig"


def _check_same(log: _Log, first: _Log) -> None:
    """Check that a log is of the same cameras as the baseline."""
    if not set(log.sizes_px) & set(first.sizes_px):
        raise IpsysError(
            f"{log.path}: has the cameras {', '.join(sorted(log.sizes_px))}, but {first.path} has "
            f"{', '.join(sorted(first.sizes_px))}; compare only logs of one lab"
        )
    for camera, (width, height) in sorted(log.sizes_px.items()):
        before = first.sizes_px.get(camera, (width, height))
        if before != (width, height):
            raise IpsysError(
                f"{log.path}: camera {camera} has images of {width} x {height} px, but in {first.path} of "
                f"{before[0]} x {before[1]} px; compare only logs with the same image size"
            )


def _find_cameras(
    paths: Sequence[LogLocation], until_ns: int
) -> tuple[str, tuple[LogLocation, str], dict[str, PosedCamera]]:
    """Return the name and the source of the first model with camera poses, and its cameras."""
    for path in paths:
        with Session([path]) as session:
            model = find_model(session, until_ns)
            lenses = {camera: session.payloads([topic])[-1] for camera, topic in session.calibrations.items()}
        if model is not None and (cameras := read_floor_cameras(model[0], lenses)):
            return model[0].name, (path, model[1]), cameras
    raise IpsysError(
        f"{paths[0]}: has no fitted model with camera poses and intrinsics; give the log of the calibration "
        "with --model-from LOG"
    )
