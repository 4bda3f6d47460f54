"""The steps of the first day: which are done, which can be done, and the missing part of the others."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from ipsys_log.app.first_day.lab_folder import FitFacts, LabFolder, LogFacts
from ipsys_log.app.report.rows import cm, counted
from ipsys_log.capture.devices import check_sources
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.calibration_files import read_intrinsics
from ipsys_log.live_runs.survey.entry import check_references
from ipsys_log.messages import Rig, RigCamera
from ipsys_log.messages.rig_file import load_rig
from ipsys_log.models.table import min_pairs
from ipsys_log.plain_text import join_names, shell_words
from ipsys_log.statistics.calibration_points import ENOUGH_DRIVE_POINTS, ENOUGH_POINTS, ENOUGH_TAPE_POINTS
from ipsys_log.vision.lenses import calibration_remarks

# The model of the tape alone. A drive with two points is the least for the model joint.
_TAPE_MODEL = "poly"
_LEAST_POINTS = 2
# A shorter recording is no drive.
_LEAST_DRIVE_S = 10.0


class Status(StrEnum):
    """The status of a step."""

    DONE = "done"
    READY = "ready"
    WAITS = "waits"


@dataclass(frozen=True, slots=True)
class StepState:
    """The state of a step.

    ``command`` does the same in a terminal. ``text`` is the result, or the missing part.
    """

    name: str
    title: str
    command: str
    status: Status
    text: str


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """The intrinsics of a camera: ``text`` names their source, or the reason if they are not ``known``.

    ``file`` is a file in the folder that could be used, but that the rig does not name.
    """

    camera: str
    known: bool
    text: str
    file: str | None = None


@dataclass(frozen=True, slots=True)
class SetupProgress:
    """All facts of a folder for the first day.

    Attributes
    ----------
    rig : the lab; None without a rig file, or if it has a fault.
    cameras : the cameras of the rig with a source.
    alignment : the newest log of an alignment; None if there is none.
    next : name of the first step that is not done and not waiting; None if all steps are done.
    """

    rig: Rig | None
    cameras: tuple[RigCamera, ...]
    intrinsics: tuple[CameraIntrinsics, ...]
    logs: tuple[LogFacts, ...]
    alignment: LogFacts | None
    fit: FitFacts | None
    steps: tuple[StepState, ...]

    @property
    def next(self) -> str | None:
        return next((step.name for step in self.steps if step.status is Status.READY), None)

    def step(self, name: str) -> StepState:
        """Return the state of a step."""
        return next(step for step in self.steps if step.name == name)


def read_progress(folder: LabFolder) -> SetupProgress:
    """Read the state of all steps from the files of a folder."""
    rig, rig_fault = _read_rig(folder.rig_file)
    cameras = tuple(camera for camera in rig.cameras if camera.source) if rig else ()
    intrinsics = tuple(_intrinsics_of(camera, folder.path) for camera in cameras)
    logs = tuple(folder.logs())
    aligned = [log for log in logs if log.alignment]
    alignment, fit = aligned[-1] if aligned else None, folder.fit()
    camera_fault = _camera_fault(cameras)
    # Each step needs the cameras, and the steps from the alignment on also need all intrinsics.
    unknown = [one.camera for one in intrinsics if not one.known]
    missing = f"first {'correct' if cameras else 'choose'} the cameras" if camera_fault else ""
    missing = missing or (f"intrinsics are missing for {join_names(unknown)}" if unknown else "")
    steps = (
        _rig_step(rig, rig_fault),
        _cameras_step(rig, cameras, camera_fault),
        _intrinsics_step(intrinsics, camera_fault),
        _alignment_step(alignment, cameras, missing),
        _drive_step(rig, cameras, logs, missing),
        _points_step(rig, cameras, logs, missing),
        _accuracy_step(folder.calibration_logs(), logs, fit),
        _live_step(rig, logs, fit, missing),
    )
    return SetupProgress(rig, cameras, intrinsics, logs, alignment, fit, steps)


def _read_rig(path: Path) -> tuple[Rig | None, str]:
    if not path.exists():
        return None, ""
    try:
        return load_rig(path), ""
    except IpsysError as error:
        return None, str(error)


def _intrinsics_of(camera: RigCamera, folder: Path) -> CameraIntrinsics:
    if camera.calibration is not None:
        assumed: dict[str, str] = {}
        try:
            lens = read_intrinsics(folder / camera.calibration, camera.name, assumed.__setitem__)
        except IpsysError as error:
            return CameraIntrinsics(camera.name, False, str(error))
        texts = [f"from {camera.calibration}", *assumed.values(), *calibration_remarks(lens)]
        return CameraIntrinsics(camera.name, True, "; ".join(texts))
    if str(camera.source).startswith("sim:"):
        return CameraIntrinsics(camera.name, True, "from the simulated lab")
    file = f"{camera.name}.yaml"
    if (folder / file).exists():
        return CameraIntrinsics(camera.name, False, f"{file} is there; lab.toml does not name it", file)
    return CameraIntrinsics(camera.name, False, "not calibrated")


def _camera_fault(cameras: tuple[RigCamera, ...]) -> str:
    if not cameras:
        return "no camera is chosen yet"
    try:
        check_sources(cameras)
    except IpsysError as error:
        return str(error)
    return ""


def _rig_step(rig: Rig | None, fault: str) -> StepState:
    command = "ipsys init lab.toml"
    if rig is None:
        return StepState("rig", "The lab", command, Status.READY, fault)
    text = f"{rig.name}: {rig.dictionary}, markers of {rig.marker_length_m:g} m"
    return StepState("rig", "The lab", command, Status.DONE, text)


def _cameras_step(rig: Rig | None, cameras: tuple[RigCamera, ...], fault: str) -> StepState:
    status = Status.WAITS if rig is None else Status.READY if fault else Status.DONE
    text = (
        "first describe the lab"
        if rig is None
        else fault or f"used: {join_names([one.name for one in cameras])}"
    )
    return StepState("cameras", "Cameras", "ipsys cameras --rig lab.toml", status, text)


def _intrinsics_step(intrinsics: tuple[CameraIntrinsics, ...], camera_fault: str) -> StepState:
    unknown = [one.camera for one in intrinsics if not one.known]
    status = Status.WAITS if camera_fault else Status.READY if unknown else Status.DONE
    text = "first choose the cameras" if camera_fault else f"missing for {join_names(unknown)}"
    if status is Status.DONE:
        text = f"known for {join_names([one.camera for one in intrinsics])}"
    named = "".join(f" --camera {camera}" for camera in unknown)
    command = f"ipsys calibrate --rig lab.toml --board 6x4{named}"
    return StepState("intrinsics", "Camera intrinsics", command, status, text)


def _alignment_step(alignment: LogFacts | None, cameras: tuple[RigCamera, ...], missing: str) -> StepState:
    title, command = "Alignment", "ipsys align --rig lab.toml -o alignment.mcap"
    if alignment is None or alignment.alignment is None:
        return StepState("alignment", title, command, Status.WAITS if missing else Status.READY, missing)
    known = {one.camera for one in alignment.alignment.cameras if one.level is not None}
    unknown = [camera.name for camera in cameras if camera.name not in known]
    status = Status.READY if unknown else Status.DONE
    text = f"no result for {join_names(unknown)}" if unknown else "measured"
    return StepState("alignment", title, command, status, f"{text} in {alignment.path.name}")


def _drive_step(
    rig: Rig | None, cameras: tuple[RigCamera, ...], logs: tuple[LogFacts, ...], missing: str
) -> StepState:
    title, command = "Drive", "ipsys record --rig lab.toml -o drive.mcap"
    drives = [log for log in logs if log.drive_s]
    longest_s = max((log.drive_s for log in drives), default=0.0)
    if longest_s >= _LEAST_DRIVE_S:
        text = f"{longest_s:.0f} s recorded in {join_names([log.path.name for log in drives])}"
        return StepState("drive", title, command, Status.DONE, text)
    if _is_enough_tape(cameras, logs):
        text = "not needed: there are enough points for the tape alone"
        return StepState("drive", title, command, Status.DONE, text)
    if not missing and rig is not None and not _can_drive(rig):
        missing = "first type the height of the robots' markers in step 1"
    text = missing or (f"only {longest_s:.0f} s are recorded; drive for two minutes" if drives else "")
    return StepState("drive", title, command, Status.WAITS if missing else Status.READY, text)


def _can_drive(rig: Rig) -> bool:
    """Return whether the rig has the height of a robot's marker, above the floor."""
    if not rig.markers:
        return bool(rig.marker_height_m)
    return any(rig.height_of(marker.id) for marker in rig.markers)


def _is_enough_tape(cameras: tuple[RigCamera, ...], logs: tuple[LogFacts, ...]) -> bool:
    """Return whether each camera has seen enough points for a calibration with the tape alone."""
    counts = [sum(log.seen.get(camera.name, 0) for log in logs) for camera in cameras]
    return bool(counts) and min(counts) >= ENOUGH_TAPE_POINTS


def _points_step(
    rig: Rig | None, cameras: tuple[RigCamera, ...], logs: tuple[LogFacts, ...], missing: str
) -> StepState:
    count = sum(log.points for log in logs)
    title, command = "Calibration points", "ipsys record --measure --points-only -o calibration.mcap"
    if rig is not None and not missing:
        try:
            check_references(rig)
        except IpsysError as error:
            missing = str(error)
    text = counted(count, "point") + " measured"
    has_drive = any(log.drive_s for log in logs)
    if (has_drive and count >= ENOUGH_DRIVE_POINTS) or _is_enough_tape(cameras, logs):
        return StepState("points", title, command, Status.DONE, text)
    text = missing or f"{text}; enough are {ENOUGH_POINTS}"
    return StepState("points", title, command, Status.WAITS if missing else Status.READY, text)


def _accuracy_step(calibration: list[Path], logs: tuple[LogFacts, ...], fit: FitFacts | None) -> StepState:
    has_drive = any(log.drive_s for log in logs)
    least = _LEAST_POINTS if has_drive else min_pairs(_TAPE_MODEL)
    names = shell_words(*(path.name for path in calibration)) or "drive.mcap calibration.mcap"
    command = f"ipsys calibrate-lab {names}"
    if calibration and not has_drive:
        command = f"ipsys replay {names} --model {_TAPE_MODEL}"
    title = "Calibration"
    if fit is not None and not fit.stale:
        text = f"calibrated with {fit.model}"
        if fit.mean_m is not None:
            text = f"mean distance to the tape points {cm(fit.mean_m, 1)} cm"
        return StepState("accuracy", title, command, Status.DONE, text)
    if sum(log.points for log in logs) < least:
        return StepState("accuracy", title, command, Status.WAITS, "first measure calibration points")
    text = f"the calibration is out of date: {fit.stale}" if fit else ""
    return StepState("accuracy", title, command, Status.READY, text)


def _live_step(rig: Rig | None, logs: tuple[LogFacts, ...], fit: FitFacts | None, missing: str) -> StepState:
    log, model = (shell_words(fit.log.name), fit.model) if fit else ("calibration.mcap", "joint")
    command = f"ipsys live --rig lab.toml --model-from {log} --model {model} -o live.mcap --web"
    tracked = [log.path.name for log in logs if log.tracked]
    if tracked:
        status, text = Status.DONE, f"tracked in {', '.join(tracked)}"
    elif missing or fit is None:
        status, text = Status.WAITS, missing or "first calibrate the lab"
    else:
        status, text = Status.READY, "" if rig is None else _unknown_bodies(rig)
    return StepState("live", "Live view", command, status, text)


def _unknown_bodies(rig: Rig) -> str:
    """Return the command that finds the poses of markers on bodies, for the first body that needs it."""
    for body in rig.bodies:
        own = [marker for marker in rig.markers if marker.robot == body.robot]
        if any(not marker.xyz_m for marker in own[1:]):
            return (
                f"the poses of the markers on {body.robot} are unknown: record it while you carry it for "
                f"20 s, then run: ipsys calibrate-body carry.mcap --robot {body.robot} --write lab.toml"
            )
    return ""
