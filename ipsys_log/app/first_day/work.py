"""The work of the steps with cameras and logs; each does what its command does, without a terminal.

An IpsysError says which fault the rig, a camera, a log or a sheet has.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ipsys_log.api import python_api as api
from ipsys_log.app.first_day.board import BoardEntry, BoardSearch
from ipsys_log.app.first_day.camera_choice import set_calibration
from ipsys_log.app.first_day.drive import DriveCoverage
from ipsys_log.app.first_day.jobs import Job
from ipsys_log.app.first_day.lab_folder import ALIGNMENT_LOG, DRIVE_LOG, LabFolder
from ipsys_log.app.report.calibration import calibration_lines
from ipsys_log.app.report.files import write_files
from ipsys_log.calibration.calibrate import CalibrationResult
from ipsys_log.capture.devices import check_sources
from ipsys_log.capture.lab import Lab, OpenLab, open_lab
from ipsys_log.capture.live_check import CameraMonitor
from ipsys_log.capture.live_plan import check_start, shown_run
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.capture.simulated import show_board
from ipsys_log.engine.graph import copy_model
from ipsys_log.engine.model_choice import applied_models
from ipsys_log.engine.request import Request
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.calibration_files import calibration_text
from ipsys_log.exchange.lab_files import load_cameras, read_lab
from ipsys_log.live_runs import pipeline
from ipsys_log.live_runs.survey.checks import baseline_names, check_entry, read_baseline
from ipsys_log.live_runs.survey.entry import check_references, parse_entry
from ipsys_log.live_runs.survey.from_log import FinishedLog, open_finished_log
from ipsys_log.live_runs.survey.lab_calibration import LabCalibration, describe_lab
from ipsys_log.live_runs.survey.live import LiveScene
from ipsys_log.live_runs.survey.sheet import add_sheet, check_sheet, read_sheet
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array, CompressedImage, CompressedVideo, Message, Model, Rig
from ipsys_log.messages.channels import RIG
from ipsys_log.sinks.sink import Sink
from ipsys_log.sinks.streams.opening import Stream, check_streams, open_live_streams, settings_of_rig
from ipsys_log.statistics.calibration_points import active_measurements
from ipsys_log.units import CM_PER_M, NS_PER_S

_LAST_STAGE = "camera-frame"
# Durations of recordings, by the time stamps of the frames, and the least number of frames of each camera.
_SHEET_S, _ALIGN_S, _LEAST_FRAMES = 5.0, 3.0, 20


# Wanted mean error of each camera.
GOAL_M = 0.003


@dataclass(frozen=True, slots=True)
class LiveRecording:
    """A live recording that a page can show: its cameras, its log, and the run of the shown model."""

    opened: OpenLab
    monitor: CameraMonitor
    log: Path
    model: Model
    run: str
    streams: tuple[Stream, ...]


def align(folder: LabFolder, job: Job) -> None:
    """Record the cameras for some seconds, and compute the camera points of the markers (``ipsys align``)."""
    with _new_log(folder, ALIGNMENT_LOG) as log:
        _record(folder, job, log, _ALIGN_S)
        if not job.is_stopped():
            api.replay(log, until=_LAST_STAGE, method="pose", progress=job.progress, say=job.say)


def calibrate(folder: LabFolder, search: BoardSearch, pictures: Path, entry: BoardEntry, job: Job) -> None:
    """Take pictures of a board until they are enough or the job is stopped, and calibrate the camera.

    This is ``ipsys calibrate --rig lab.toml --board BOARD --camera NAME``; it also writes the file into the
    rig. Simulated cameras show the board.
    """
    rig, cameras = load_cameras(folder.rig_file, [search.camera])
    check_sources(cameras)
    shown = [show_board(camera, entry.board) for camera in cameras]
    job.say(f"opening {search.camera}")
    with open_lab(Lab(rig, shown, {}, folder.path), job.say) as opened:
        attached = opened.cameras
        job.on_stop(attached.stop)
        with ThreadPoolExecutor(1, "board") as pool:
            working: Future[object] = pool.submit(str)
            for message in attached:
                image = None if message is None else message.payload
                # Images that arrive during a search are left out.
                if isinstance(image, (CompressedImage, CompressedVideo)) and working.done():
                    working.result()  # raises the error of the search
                    working = pool.submit(search.look, image)
                if search.is_enough:
                    attached.stop()
        working.result()
    job.say(f"{search.count} pictures are in {pictures.parent.name}/{pictures.name}")
    # A stop ends the search early: the pictures so far count.
    (outcome,) = api.calibrate(
        pictures, **entry._asdict(), cameras=[search.camera], progress=job.note_progress
    )
    if not isinstance(outcome, CalibrationResult):
        raise IpsysError(outcome.reason)
    file = f"{search.camera}.yaml"
    write_files(folder.path, {file: calibration_text(outcome).encode()})
    set_calibration(folder.rig_file, search.camera, file)
    for line in (*calibration_lines(outcome), *outcome.notes):
        job.say(line)


def drive(
    folder: LabFolder, show: Callable[[DriveCoverage], AbstractContextManager[object]], job: Job
) -> None:
    """Record a drive until the job is stopped (``ipsys record``)."""
    with _new_log(folder, DRIVE_LOG) as log, _open_cameras(folder, job) as (opened, monitor):
        check_start(opened.rig, opened.lab.names, opened.lenses, Request(), "detect")
        with closing(DriveCoverage(opened.rig, opened.lab.names)) as coverage, show(coverage):
            job.say("drive through all images")
            pipeline.record(opened.cameras, opened.settings, log, [monitor, coverage])


def measure_sheet(folder: LabFolder, sheet: Path, count: int | None, job: Job) -> None:
    """Record stationary markers, and append tape measurements of a sheet, and the distance AB.

    This is ``ipsys record``, and then ``ipsys measure LOG --csv SHEET``.

    ``count`` rows are spread over the floor, without those near to a measured point; None: all rows.
    """
    with _new_log(folder, "calibration") as log:
        _record(folder, job, log, _SHEET_S)
        if job.is_stopped():
            return
        check_sheet(sheet, log, Request())
        with open_finished_log(log, Request(), job.progress, job.say) as scene, TemporaryDirectory() as made:
            chosen = sheet
            if count is not None:
                chosen = Path(made) / sheet.name
                done_m = [place_m for one in folder.logs() for place_m in one.places_m]
                chosen.write_text(choose_rows(sheet, scene.rig, done_m, count), encoding="utf-8")
            for remark in add_sheet(scene, chosen):
                job.say(remark)
            _add_baseline(scene)


def _add_baseline(scene: FinishedLog) -> None:
    """Append the distance AB as the tape of the simulated lab reads it, in whole mm, if it counts."""
    rig = scene.rig
    if rig.ab_sigma_m is None:
        return
    first, second = (next(p for p in rig.reference_points if p.name == name) for name in baseline_names(rig))
    apart_cm = CM_PER_M * math.hypot(second.x_m - first.x_m, second.y_m - first.y_m)
    scene.add([read_baseline(f"{apart_cm:.1f}", rig, scene.history(), scene.start_ns)])


def measure(folder: LabFolder, show: Callable[[LiveScene], AbstractContextManager[object]], job: Job) -> None:
    """Measure points with live cameras until the job is stopped (``ipsys record --measure --points-only``).

    Then the markers are detected, so that the points of each camera can be counted.
    """
    with _new_log(folder, "calibration") as log:
        with _open_cameras(folder, job) as (opened, monitor):
            check_references(opened.rig)
            check_start(opened.rig, opened.lab.names, opened.lenses, Request(), _LAST_STAGE)
            scene = LiveScene(opened.rig, None, opened.cameras.states, opened.cameras.save)
            with show(scene):
                job.say("open the measuring page")
                pipeline.measure(opened.cameras, opened.settings, log, Request(), [scene, monitor])
        if active_measurements(scene.history()):
            api.replay(log, until=_LAST_STAGE, progress=job.note_progress, say=job.say)


def calibrate_lab(folder: LabFolder, job: Job) -> LabCalibration | None:
    """Fit a model to all drives and calibration points of the folder; return its expected errors.

    With a drive, this is ``ipsys calibrate-lab``. Without one, it is ``ipsys replay --model poly``, which
    evaluates the model, and returns None. A stop keeps the finished runs; the logs get no part of a run.
    """
    logs = folder.calibration_logs()
    if not folder.has_drive():
        api.replay(*logs, models=("poly",), progress=job.progress, say=job.say)
        return None
    api.replay(*logs, models=("joint",), until="fit", progress=job.progress, say=job.say)
    fit = folder.fit()
    if fit is None:
        raise IpsysError("the logs have no calibration; calibrate again")
    with Session(logs) as session:
        rig = session.payloads(session.topics(RIG))[-1]
        lenses = {camera: session.payloads([topic])[-1] for camera, topic in session.calibrations.items()}
        return describe_lab(
            session, fit.run, rig, lenses, (None, {}), "train", GOAL_M,
            lambda done, total: job.progress("describe", done, total),
        )  # fmt: skip


def track(folder: LabFolder, show: Callable[[LiveRecording], AbstractContextManager[Sink]], job: Job) -> None:
    """Track robots with live cameras until the job is stopped (``ipsys live``).

    ``show`` shows the dashboard of a recording; its value gets the recorded messages.
    """
    fit = folder.fit()
    if fit is None:
        raise IpsysError("the folder has no model; calibrate the lab first")
    request = Request(model_from=fit.log, models=(fit.model,))
    with _new_log(folder, "live") as log, _open_cameras(folder, job) as (opened, monitor):
        for line in check_start(opened.rig, opened.lab.names, opened.lenses, request, None):
            job.say(line)
        run = shown_run(request)
        streamed = settings_of_rig(opened.rig.stream, folder.path)
        for line in check_streams(streamed):
            job.say(line)
        with open_live_streams(streamed, opened, run) as streams:
            model = copy_model(request, applied_models(request)[0][0])[1]
            view = LiveRecording(opened, monitor, log, model, run, tuple(streams))
            with show(view) as sink:
                job.say("open the dashboard")
                sinks: list[Sink] = [monitor, sink, *streams]
                pipeline.live(opened.cameras, opened.settings, log, request, sinks=sinks)


@contextmanager
def _new_log(folder: LabFolder, name: str) -> Iterator[Path]:
    """Yield the path of a new log; it counts from the end of the block on."""
    try:
        yield folder.new_log(name)
    finally:
        folder.finish_log()


@contextmanager
def _open_cameras(folder: LabFolder, job: Job) -> Iterator[tuple[OpenLab, CameraMonitor]]:
    """Open the cameras of the rig with their live check; a stop of the job ends them in order."""
    lab = read_lab(folder.rig_file)
    job.say(f"opening {', '.join(lab.names)}")
    with open_lab(lab, job.say) as opened, CameraMonitor(lab.rig) as monitor:
        job.on_stop(opened.cameras.stop)
        room = opened.room(folder.rig_file)
        # Devices that only view the page see this, too: the path of the folder is not for them.
        job.say(replace(room, folder=Path(room.folder.name)).describe(None))
        yield opened, monitor


def _record(folder: LabFolder, job: Job, log: Path, seconds: float) -> None:
    """Record all cameras into a new log for some seconds."""
    with _open_cameras(folder, job) as (opened, _):
        job.say(f"the cameras are open; {log.name} gets {seconds:g} s")
        enough = _Enough(opened.cameras, seconds, job)
        pipeline.record(opened.cameras, opened.settings, log, [enough])


class _Enough:
    """A sink that stops the cameras when each has sent frames for some seconds.

    It counts the time by the frames, so that a slow machine records the same scene.
    """

    def __init__(self, cameras: LiveCameras, seconds: float, job: Job) -> None:
        self._cameras, self._job = cameras, job
        self._span_ns = round(seconds * NS_PER_S)
        self._first_ns: dict[str, int] = {}
        self._counts = dict.fromkeys(cameras.states, 0)
        self._done: set[str] = set()

    def __call__(self, message: Message) -> None:
        """Count a frame."""
        if message.camera not in self._counts:
            return
        camera = message.camera
        self._counts[camera] += 1
        begin_ns = self._first_ns.setdefault(camera, message.publish_time_ns)
        span_ns = message.publish_time_ns - begin_ns
        if span_ns >= self._span_ns and self._counts[camera] >= _LEAST_FRAMES:
            self._done.add(camera)
        shares = min(self._counts.values())
        self._job.note_progress("frames of each camera", shares, None)
        if len(self._done) == len(self._counts):
            self._cameras.stop()


# Places are proposed on a grid of so many points along each side of the floor, away from its edge.
_GRID, _EDGE = 9, 0.15
# The tapes from A and B must cross at this angle or more.
_LEAST_CROSSING_RAD = math.radians(35)
# A point closer than this to a measured one adds little.
_NEAR_M = 0.4


def propose_places(rig: Rig, done_m: Sequence[tuple[float, float]], count: int) -> list[tuple[float, float]]:
    """Return up to ``count`` places (x, y), each far from the measured points and from the others.

    The two tapes cross well at each place. Without a floor or two reference points, there is none.
    """
    if rig.floor is None or len(rig.reference_points) < 2:
        return []
    shares = np.linspace(_EDGE, 1 - _EDGE, _GRID)
    grid_m = np.stack(np.meshgrid(shares * rig.floor.width_m, shares * rig.floor.depth_m), axis=-1)
    return _spread(grid_m.reshape(-1, 2), rig, done_m, count)


def _spread(
    candidates_m: Array, rig: Rig, done_m: Sequence[tuple[float, float]], count: int
) -> list[tuple[float, float]]:
    """Return the candidates (n, 2) that are farthest from the points so far, one after the other."""
    a, b = (np.array([point.x_m, point.y_m]) for point in rig.reference_points[:2])
    to_a, to_b = a - candidates_m, b - candidates_m
    across = np.abs(to_a[:, 0] * to_b[:, 1] - to_a[:, 1] * to_b[:, 0])
    sines = across / np.maximum(np.linalg.norm(to_a, axis=1) * np.linalg.norm(to_b, axis=1), 1e-9)
    good_m = candidates_m[sines >= math.sin(_LEAST_CROSSING_RAD)]
    if not len(good_m):
        good_m = candidates_m
    so_far_m = [*done_m] or [tuple((a + b) / 2)]
    chosen: list[tuple[float, float]] = []
    while len(chosen) < count:
        distances_m = np.linalg.norm(good_m[:, None] - np.array([*so_far_m, *chosen])[None], axis=2).min(
            axis=1
        )
        best = int(distances_m.argmax())
        if distances_m[best] < _NEAR_M:
            break
        chosen.append((float(good_m[best, 0]), float(good_m[best, 1])))
        so_far_m = so_far_m if done_m else []  # the middle of AB only begins the first place
    return chosen


def choose_rows(sheet: Path, rig: Rig, done_m: Sequence[tuple[float, float]], count: int) -> str:
    """Return a sheet with the header and ``count`` of its rows, spread over the floor.

    Rows at measured points are left out.
    """
    rows = read_sheet(sheet, rig, 0)
    checked = [check_entry(*parse_entry(row.typed, rig), rig, None, ()) for row in rows]
    lines = {
        (float(one.point_m[0]), float(one.point_m[1])): row.line
        for row, one in zip(rows, checked, strict=True)
        if one.point_m is not None
    }
    chosen = _spread(np.array(list(lines)), rig, done_m, count)
    text = sheet.read_text(encoding="utf-8-sig").splitlines()
    return "\n".join([text[0], *(text[number - 1] for number in sorted(lines[place] for place in chosen))])


def describe_map(
    rig: Rig, done_m: Sequence[tuple[float, float]], proposed_m: Sequence[tuple[float, float]]
) -> dict[str, Any] | None:
    """Return the map as plain data; a proposed place has its distances to the reference points in cm."""
    if rig.floor is None:
        return None
    references = [{"name": point.name, "x_m": point.x_m, "y_m": point.y_m} for point in rig.reference_points]
    return {
        "floor": [rig.floor.width_m, rig.floor.depth_m],
        "references": references,
        "done": [list(place_m) for place_m in done_m],
        "proposed": [
            {
                "point_m": list(place_m),
                "tapes": {
                    point.name: round(CM_PER_M * math.dist(place_m, (point.x_m, point.y_m)))
                    for point in rig.reference_points
                },
            }
            for place_m in proposed_m
        ],
    }
