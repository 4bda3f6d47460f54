"""The setup of a lab as one session: its state as plain data, and the actions of its steps."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict
from functools import partial
from typing import Any, NamedTuple

from ipsys_log.app.first_day import work
from ipsys_log.app.first_day.alignment import AlignmentResult
from ipsys_log.app.first_day.board import BOARD_FIELDS, DICTIONARIES, BoardSearch, parse_board_entry
from ipsys_log.app.first_day.camera_choice import parse_camera_address, save_cameras, set_calibration
from ipsys_log.app.first_day.camera_pictures import CameraPictures
from ipsys_log.app.first_day.drive import DriveCoverage
from ipsys_log.app.first_day.jobs import Job, Jobs
from ipsys_log.app.first_day.lab_folder import FitFacts, LabFolder, exclude_outlier
from ipsys_log.app.first_day.rig_entry import LABELS, example_rig, rig_fields, rig_warnings, save_rig_entry
from ipsys_log.app.first_day.steps import SetupProgress, Status, read_progress
from ipsys_log.app.first_day.work import describe_map, propose_places
from ipsys_log.app.report.calibration import lab_advice, lab_headline, lab_table
from ipsys_log.app.report.rows import cm
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.lab_files import simulated_lab_texts, write_new
from ipsys_log.extras import check_installed
from ipsys_log.live_runs.survey.entry import Fault
from ipsys_log.live_runs.survey.lab_calibration import LabCalibration
from ipsys_log.live_runs.survey.live import LiveScene
from ipsys_log.messages.rig_file import load_rig
from ipsys_log.sinks.sink import Sink
from ipsys_log.statistics.calibration_points import ENOUGH_DRIVE_POINTS, ENOUGH_POINTS

# The simulated tape measures so many points at once.
_SHEET_POINTS = ENOUGH_DRIVE_POINTS


class Pages(NamedTuple):
    """The functions that show a measuring page and a dashboard until the end of their block."""

    measuring: Callable[[LiveScene], AbstractContextManager[object]]
    dashboard: Callable[[work.LiveRecording], AbstractContextManager[Sink]]


class SetupSession:
    """The setup of the lab in a folder. Its state comes from the files of the folder.

    Only pictures of cameras and the present job are in memory. An action raises an IpsysError if a job works,
    if an earlier step is missing, or if a file or a typed name has a fault.
    """

    def __init__(self, folder: LabFolder, pages: Pages) -> None:
        self.jobs = Jobs()
        self._folder, self._pages = folder, pages
        self._cameras = CameraPictures(folder.rig_file)
        self._search: BoardSearch | None = None
        self._alignment: AlignmentResult | None = None
        self._drive: DriveCoverage | None = None
        self._lab: tuple[FitFacts, LabCalibration] | None = None
        self._actions: dict[str, tuple[str, str, Callable[[Job], None]]] = {
            "pictures": ("the pictures of the cameras", "cameras", self._cameras.take_all),
            "align": ("the alignment", "alignment", lambda job: work.align(folder, job)),
            "drive": ("the drive", "drive", lambda job: work.drive(folder, self._show_drive, job)),
            "sheet": ("the measuring by the sheet", "points", partial(self._measure_sheet, _SHEET_POINTS)),
            "sheet-all": ("the measuring by the sheet", "points", partial(self._measure_sheet, None)),
            "measure": (
                "the measuring", "points", lambda job: work.measure(folder, pages.measuring, job),
            ),
            "calibrate-lab": ("the calibration", "accuracy", self._calibrate_lab),
            "live": ("the live view", "live", lambda job: work.track(folder, pages.dashboard, job)),
        }  # fmt: skip

    def describe(self) -> dict[str, Any]:
        """Return the whole state as plain data."""
        progress = read_progress(self._folder)
        job, drive = self.jobs.present, self._drive
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
            "drive": {
                "logs": [[log.path.name, round(log.drive_s)] for log in progress.logs if log.drive_s],
                "views": None if drive is None else drive.describe(),
                "seconds": 0 if drive is None else int(drive.seconds),
            },
            "points": {
                "sheet": None if self._folder.sheet is None else self._folder.sheet.name,
                "enough": ENOUGH_POINTS,
                "logs": [[log.path.name, log.points, dict(log.seen)] for log in progress.logs if log.points],
            },
            "map": self._describe_map(progress),
            "accuracy": None if progress.fit is None else _describe_fit(progress.fit),
            "lab": self._describe_lab(progress),
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
        """Return a picture: ``camera`` by number, ``board``, ``drive`` and ``alignment`` by camera."""
        if kind == "board":
            return None if self._search is None else self._search.picture()
        if kind == "camera":
            return self._cameras.picture(name)
        if kind == "drive":
            return None if self._drive is None else self._drive.picture(name)
        cameras = () if self._alignment is None else self._alignment.cameras
        return next((one.picture for one in cameras if one.camera == name), None)

    def print_pdf(self, name: str, typed: Mapping[str, str]) -> bytes:
        """Return a print as PDF: ``markers`` of the rig, or the ``board`` of typed fields."""
        check_installed("a print needs", "matplotlib")
        from ipsys_log.app.report.prints import board_print, choose_paper, draw_pages, lay_out, rig_prints

        if name == "markers":
            rig = load_rig(self._folder.rig_file)
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

    def _measure_sheet(self, count: int | None, job: Job) -> None:
        sheet = self._folder.sheet
        if sheet is None:
            raise IpsysError("the folder has no sheet lab_tape.csv; only the simulated lab has one")
        work.measure_sheet(self._folder, sheet, count, job)

    def _calibrate_lab(self, job: Job) -> None:
        lab, fit = work.calibrate_lab(self._folder, job), self._folder.fit()
        self._lab = None if lab is None or fit is None else (fit, lab)

    @contextmanager
    def _show_drive(self, drive: DriveCoverage) -> Iterator[None]:
        self._drive = drive
        try:
            yield
        finally:
            self._drive = None

    def _current_lab(self, progress: SetupProgress) -> LabCalibration | None:
        """Return the result of the present fit; None after a restart, or if a log has changed since."""
        return self._lab[1] if self._lab is not None and self._lab[0] == progress.fit else None

    def _describe_map(self, progress: SetupProgress) -> dict[str, Any] | None:
        """Return the floor with its points; None without a floor."""
        rig, lab = progress.rig, self._current_lab(progress)
        if rig is None:
            return None
        done_m = [place_m for log in progress.logs for place_m in log.places_m]
        proposed_m: list[tuple[float, float]] = []
        if lab is None:
            proposed_m = propose_places(rig, done_m, max(2 * ENOUGH_DRIVE_POINTS - len(done_m), 0))
        elif not lab.is_enough:
            proposed_m = [(float(point.point_m[0]), float(point.point_m[1])) for point in lab.points]
        return describe_map(rig, done_m, proposed_m)

    def _describe_lab(self, progress: SetupProgress) -> dict[str, Any] | None:
        """Return the expected errors, and what is missing."""
        lab = self._current_lab(progress)
        if lab is None:
            return None
        table = lab_table(lab)
        return {
            "enough": lab.is_enough,
            "headline": list(lab_headline(lab)),
            "advice": [line for line in lab_advice(lab) if line],
            "title": table.title,
            "columns": [name.lstrip(">") for name in table.columns],
            "rows": table.cells,
            "gap": None
            if lab.gap is None or lab.is_enough
            else [lab.gap.low_m.tolist(), lab.gap.high_m.tolist()],
            "notes": list(lab.notes),
        }


def _describe_fit(fit: FitFacts) -> dict[str, Any]:
    """Return the result of the fit: one figure, the points to measure again, and the full answer."""
    figure = "" if fit.mean_m is None else f"Mean distance to the tape points: {cm(fit.mean_m, 1)} cm"
    return {"figure": figure, "outliers": [asdict(one) for one in fit.outliers], "answer": list(fit.answer)}
