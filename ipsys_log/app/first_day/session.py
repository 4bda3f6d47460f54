"""The setup of a lab as one session: its state as plain data, and the actions of its steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict
from typing import Any, NamedTuple

from ipsys_log.app.first_day import work
from ipsys_log.app.first_day.alignment import AlignmentResult
from ipsys_log.app.first_day.board import BOARD_FIELDS, BoardSearch, parse_board_entry
from ipsys_log.app.first_day.camera_choice import parse_camera_address, save_cameras, set_calibration
from ipsys_log.app.first_day.camera_pictures import CameraPictures
from ipsys_log.app.first_day.jobs import Job, Jobs
from ipsys_log.app.first_day.lab_folder import FitFacts, LabFolder, exclude_outlier
from ipsys_log.app.first_day.rig_entry import LABELS, example_rig, rig_fields, rig_warnings, save_rig_entry
from ipsys_log.app.first_day.steps import SetupProgress, Status, read_progress
from ipsys_log.app.report.rows import cm
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.lab_files import simulated_lab_texts, write_new
from ipsys_log.extras import check_installed
from ipsys_log.live_runs.survey.entry import Fault
from ipsys_log.live_runs.survey.live import LiveScene
from ipsys_log.messages.rig_file import load_rig
from ipsys_log.sinks.sink import Sink

# The dictionaries that the page offers first; the field takes any other name of OpenCV, too.
DICTIONARIES = (
    *("DICT_4X4_50", "DICT_4X4_100", "DICT_4X4_250", "DICT_5X5_100", "DICT_6X6_250"),
    *("DICT_APRILTAG_25h9", "DICT_APRILTAG_36h11"),
)


class Pages(NamedTuple):
    """The functions that show a measuring page and a dashboard until the end of their block."""

    measuring: Callable[[LiveScene], AbstractContextManager[object]]
    dashboard: Callable[[work.LiveRecording], AbstractContextManager[Sink]]


class SetupSession:
    """The setup of the lab in a folder. Its state comes from the files of the folder.

    Only pictures of cameras and the present job are in memory. An action raises an IpsysError if a job works,
    if an earlier step is missing, or if a file or a typed name has a fault.

    Parameters
    ----------
    folder : the folder.
    pages : the pages of the steps with live cameras.

    Attributes
    ----------
    jobs : the present job.
    """

    def __init__(self, folder: LabFolder, pages: Pages) -> None:
        self.jobs = Jobs()
        self._folder, self._pages = folder, pages
        self._cameras = CameraPictures(folder.rig_file)
        self._search: BoardSearch | None = None
        self._alignment: AlignmentResult | None = None
        self._actions: dict[str, tuple[str, str, Callable[[Job], None]]] = {
            "pictures": ("the pictures of the cameras", "cameras", self._cameras.take_all),
            "align": ("the alignment", "alignment", lambda job: work.align(folder, job)),
            "sheet": ("the measuring by the sheet", "points", self._measure_sheet),
            "measure": (
                "the measuring", "points", lambda job: work.measure(folder, pages.measuring, job),
            ),
            "replay": ("the fit", "accuracy", lambda job: work.fit_and_evaluate(folder, job)),
            "live": ("the live view", "live", lambda job: work.track(folder, pages.dashboard, job)),
        }  # fmt: skip

    def describe(self) -> dict[str, Any]:
        """Return the whole state as plain data."""
        progress = read_progress(self._folder)
        job = self.jobs.present
        return {
            "folder": self._folder.path.absolute().name,
            "next": progress.next,
            "steps": [asdict(step) for step in progress.steps],
            "rig": self._describe_rig(progress),
            "cameras": self._cameras.describe(progress.rig),
            "attached": len(self._cameras.attached()),
            "address": self._cameras.describe_address(),
            "intrinsics": [asdict(one) for one in progress.intrinsics],
            "board_fields": BOARD_FIELDS,
            "board": self._describe_board(),
            "alignment": self._describe_alignment(progress),
            "points": {
                "sheet": None if self._folder.sheet is None else self._folder.sheet.name,
                "logs": [[log.path.name, log.points] for log in progress.logs if log.points],
            },
            "accuracy": None if progress.fit is None else _describe_fit(progress.fit),
            "tracked": [log.path.name for log in progress.logs if log.tracked],
            "faults": [log.fault for log in progress.logs if log.fault],
            "job": None if job is None else job.describe(),
        }

    def save_rig(self, typed: Mapping[str, str]) -> list[Fault]:
        """Write the typed rig; return the faults of its fields instead."""
        self._check_idle()
        return save_rig_entry(self._folder.rig_file, typed)

    def simulate(self) -> None:
        """Write the rig of the simulated lab and its sheet (``ipsys init lab.toml --simulated``)."""
        write_new(simulated_lab_texts(self._folder.rig_file))

    def save_cameras(self, names: Mapping[str, str]) -> list[Fault]:
        """Write the named cameras into the rig file; return the faults of names instead."""
        self._check_idle()
        return save_cameras(self._folder.rig_file, names, self._cameras.attached())

    def add_camera(self, typed: Mapping[str, str]) -> list[Fault]:
        """Start to open the camera of a typed address; return the fault of a field instead.

        With a picture, the camera is written into the rig file. Without one, the state has the fault.
        """
        self._check_idle()
        self._cameras.forget_fault()
        camera = parse_camera_address(typed, load_rig(self._folder.rig_file))
        if isinstance(camera, Fault):
            return [camera]
        self.jobs.start(
            f"the picture of camera {camera.name}", lambda job: self._cameras.add(camera, job), "address"
        )
        return []

    def use_intrinsics(self, camera: str) -> None:
        """Write the file of intrinsics of a camera into the rig file."""
        self._check_idle()
        files = {one.camera: one.file for one in read_progress(self._folder).intrinsics}
        file = files.get(camera)
        if file is None:
            raise IpsysError(f"the folder has no new intrinsics of camera {camera!r}; calibrate it first")
        set_calibration(self._folder.rig_file, camera, file)

    def calibrate(self, camera: str, typed: Mapping[str, str]) -> list[Fault]:
        """Start the calibration of a camera with a board; return the fault of a field instead."""
        self._check_idle()
        step = read_progress(self._folder)
        if camera not in [one.camera for one in step.intrinsics]:
            raise IpsysError(f"lab.toml has no camera {camera!r} with a source; reload this page")
        entry = parse_board_entry(typed)
        if isinstance(entry, Fault):
            return [entry]
        pictures = self._folder.new_board_folder(camera)
        search = self._search = BoardSearch(camera, entry.parse(), pictures)
        self.jobs.start(
            f"the calibration of {camera}",
            lambda job: work.calibrate(self._folder, search, pictures, entry, job),
            "calibrate",
        )
        return []

    def exclude(self, log: str, point: str) -> None:
        """Exclude a calibration point that contradicts the fit."""
        self._check_idle()
        exclude_outlier(self._folder.calibration_logs(), log, point)

    def start(self, action: str) -> None:
        """Start the job of an action."""
        if action not in self._actions:
            raise IpsysError(f"the action {action!r} is not known; reload this page")
        title, name, job = self._actions[action]
        step = read_progress(self._folder).step(name)
        if step.status is Status.WAITS:
            raise IpsysError(f"{step.title}: {step.text}")
        self.jobs.start(title, job, action)

    def picture(self, kind: str, name: str) -> bytes | None:
        """Return a picture: ``board`` of the calibration, ``camera`` by number, ``alignment`` by camera."""
        if kind == "board":
            return None if self._search is None else self._search.picture()
        if kind == "camera":
            return self._cameras.picture(name)
        cameras = () if self._alignment is None else self._alignment.cameras
        return next((one.picture for one in cameras if one.camera == name), None)

    def print_pdf(self, name: str, typed: Mapping[str, str]) -> bytes:
        """Return a print as PDF: ``markers`` of the rig, or the ``board`` of typed fields."""
        return _print(self._folder, name, typed)

    def close(self) -> None:
        """Stop the present job in order."""
        self.jobs.close()

    def _check_idle(self) -> None:
        job = self.jobs.present
        if job is not None and not job.ended:
            raise IpsysError(f"{job.name} is not finished; wait for it, or stop it")

    def _describe_board(self) -> dict[str, Any] | None:
        """Return the pictures of a board that a camera takes now; None without a calibration."""
        job = self.jobs.present
        if self._search is None or job is None or job.ended or job.action != "calibrate":
            return None
        return self._search.describe() or None

    def _describe_rig(self, progress: SetupProgress) -> dict[str, Any]:
        return {
            "exists": self._folder.rig_file.exists(),
            "name": progress.rig.name if progress.rig else None,
            "values": rig_fields(progress.rig or example_rig()),
            "warnings": rig_warnings(progress.rig) if progress.rig else [],
            "labels": LABELS,
            "dictionaries": DICTIONARIES,
        }

    def _describe_alignment(self, progress: SetupProgress) -> dict[str, Any] | None:
        log = progress.alignment
        if log is None or log.alignment is None:
            return None
        result = self._alignment = log.alignment
        cameras = [
            asdict(one)
            | {"picture": f"picture/alignment/{one.camera}?{log.start_ns}" if one.picture else None}
            for one in result.cameras
        ]
        return {"cameras": cameras, "coverage": result.coverage, "notes": result.notes}

    def _measure_sheet(self, job: Job) -> None:
        sheet = self._folder.sheet
        if sheet is None:
            raise IpsysError("the folder has no sheet lab_tape.csv; only the simulated lab has one")
        work.measure_sheet(self._folder, sheet, job)


def _describe_fit(fit: FitFacts) -> dict[str, Any]:
    """Return the result of the fit: one figure, the points to measure again, and the full answer."""
    figure = "" if fit.mean_m is None else f"Mean distance to the tape points: {cm(fit.mean_m, 1)} cm"
    return {"figure": figure, "outliers": [asdict(one) for one in fit.outliers], "answer": list(fit.answer)}


def _print(folder: LabFolder, name: str, typed: Mapping[str, str]) -> bytes:
    """Return the markers of the rig file, or a board of typed fields, as PDF (``ipsys markers``)."""
    check_installed("a print needs", "matplotlib")
    from ipsys_log.app.report.prints import board_print, choose_paper, draw_pages, lay_out, rig_prints

    if name == "markers":
        rig = load_rig(folder.rig_file)
        if not rig.all_markers:
            raise IpsysError("lab.toml lists no markers; type the ids of the robots, and save them")
        prints = rig_prints(rig)
    elif name == "board":
        entry = parse_board_entry(typed)
        if isinstance(entry, Fault):
            raise IpsysError(entry.text)
        prints = [board_print(entry.parse(), entry.board)]
    else:
        raise IpsysError(f"the print {name!r} is not known; reload this page")
    # A4 means the usual choice: A3 if A4 is too small.
    paper = typed.get("paper", "A4")
    return draw_pages(lay_out(prints, choose_paper(prints, None if paper == "A4" else paper)))
