"""The work of the steps with cameras and logs; each does what its command does, without a terminal.

An IpsysError says which fault the rig, a camera, a log or a sheet has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from ipsys_log.api import python_api as api
from ipsys_log.app.first_day.board import BoardEntry, BoardSearch
from ipsys_log.app.first_day.camera_choice import set_calibration
from ipsys_log.app.first_day.jobs import Job
from ipsys_log.app.first_day.lab_folder import ALIGNMENT_LOG, LabFolder
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
from ipsys_log.live_runs.survey.entry import check_references
from ipsys_log.live_runs.survey.from_log import open_finished_log
from ipsys_log.live_runs.survey.live import LiveScene
from ipsys_log.live_runs.survey.sheet import add_sheet, check_sheet
from ipsys_log.messages import CompressedImage, CompressedVideo, Message, Model
from ipsys_log.sinks.sink import Sink
from ipsys_log.sinks.streams.opening import Stream, check_streams, open_live_streams, settings_of_rig
from ipsys_log.units import NS_PER_S

_LAST_STAGE = "camera-frame"
# Durations of recordings, by the time stamps of the frames, and the least number of frames of each camera.
_SHEET_S, _ALIGN_S, _LEAST_FRAMES = 5.0, 3.0, 20


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


def measure_sheet(folder: LabFolder, sheet: Path, job: Job) -> None:
    """Record stationary markers, and append the tape measurements of a sheet.

    This is ``ipsys record``, and then ``ipsys measure LOG --csv SHEET``.
    """
    with _new_log(folder, "calibration") as log:
        _record(folder, job, log, _SHEET_S)
        if job.is_stopped():
            return
        check_sheet(sheet, log, Request())
        with open_finished_log(log, Request(), job.progress, job.say) as scene:
            for remark in add_sheet(scene, sheet):
                job.say(remark)


def measure(folder: LabFolder, show: Callable[[LiveScene], AbstractContextManager[object]], job: Job) -> None:
    """Measure points with live cameras until the job is stopped (``ipsys record --measure --points-only``).

    Parameters
    ----------
    show : shows the measuring page of a scene.
    """
    with _new_log(folder, "calibration") as log, _open_cameras(folder, job) as (opened, monitor):
        check_references(opened.rig)
        check_start(opened.rig, opened.lab.names, opened.lenses, Request(), _LAST_STAGE)
        scene = LiveScene(opened.rig, None, opened.cameras.states, opened.cameras.save)
        with show(scene):
            job.say("open the measuring page")
            pipeline.measure(opened.cameras, opened.settings, log, Request(), [scene, monitor])


def fit_and_evaluate(folder: LabFolder, job: Job) -> None:
    """Fit the model to all calibration points of the folder, and evaluate it (``ipsys replay``).

    A stop keeps the finished runs; the logs get no part of a run.
    """
    api.replay(*folder.calibration_logs(), progress=job.progress, say=job.say)


def track(folder: LabFolder, show: Callable[[LiveRecording], AbstractContextManager[Sink]], job: Job) -> None:
    """Track robots with live cameras until the job is stopped (``ipsys live``).

    Parameters
    ----------
    show : shows the dashboard of a recording; its value gets the recorded messages.
    """
    request = Request(model_from=folder.calibration_logs()[-1])
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
