"""Reading of logs for the drift of their cameras, with the checks of the input."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from ipsys_log.engine.mended_model import find_model
from ipsys_log.engine.provenance import newest_run
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import Rig
from ipsys_log.messages.channels import MARKERS, RIG
from ipsys_log.plain_text import shell_words
from ipsys_log.statistics.camera_moves import DriftLog, LabDrift, find_drift, image_sizes, read_windows
from ipsys_log.statistics.drift import Motion
from ipsys_log.statistics.floor_cameras import read_floor_cameras
from ipsys_log.vision.poses import PosedCamera


@dataclass(slots=True, eq=False)
class DriftReading:
    """The drift over logs, and its sources.

    Attributes
    ----------
    paths, names : the logs in order of time, and their short names; the first is the baseline.
    model : name of the model with the camera poses; ``source`` are its log and its topic.
    remarks : on logs that were left out, and others.
    """

    drift: LabDrift
    paths: list[LogLocation]
    names: list[str]
    model: str
    source: tuple[LogLocation, str]
    remarks: list[str] = field(default_factory=list)

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
    return DriftReading(drift, kept, [log.name for log in windows], model, source, remarks)


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
