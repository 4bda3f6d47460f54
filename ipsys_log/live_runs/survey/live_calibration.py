"""Joint calibration beside a recording: coverage and expected error while the robots drive."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.from_messages import gather_observations
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey.lab_calibration import LabCalibration, describe_fit
from ipsys_log.messages import CameraCalibration, Markers, Measurement, Message, Rig
from ipsys_log.statistics.calibration_points import active_baselines, active_measurements
from ipsys_log.statistics.joint_evaluation import fit_without, is_nominal
from ipsys_log.statistics.marker_tests import find_contradicted_inputs
from ipsys_log.units import MM_PER_M, NS_PER_S

# The fit beside the recording uses a part of the sightings, so that it leaves time for the detection.
_STEP_NS = NS_PER_S // 5
# Cells of an image, along its width and height, for the coverage before the first fit.
_CELLS = 8, 5


class LiveCalibration:
    """A sink of a recording that fits the lab again every few seconds, in its own thread.

    An error of a fit is text for the user. It cannot end the recording. A bug is raised by a later
    message, or by ``close``.

    Parameters
    ----------
    rig, lenses : rig and intrinsics of the recording.
    goal_m : wanted mean error of every camera.
    say : called with one line after each fit.
    every_s : time of the log between two lines.

    Attributes
    ----------
    lab : the newest result; None before the first fit.
    """

    def __init__(
        self,
        rig: Rig,
        lenses: Mapping[str, CameraCalibration],
        goal_m: float,
        say: Callable[[str], None],
        every_s: float = 10.0,
    ) -> None:
        self.lab: LabCalibration | None = None
        self._rig, self._lenses, self._goal_m, self._say = rig, lenses, goal_m, say
        self._every_ns = round(every_s * NS_PER_S)
        self._next_ns = 0
        self._markers: dict[str, list[Markers]] = {camera: [] for camera in sorted(lenses)}
        self._cells: dict[str, NDArray[np.bool_]] = {camera: np.zeros(_CELLS, np.bool_) for camera in lenses}
        self._entered: list[Measurement] = []
        self._worker = ThreadPoolExecutor(1, "calibration")
        self._fitting: Future[None] | None = None

    def __call__(self, message: Message) -> None:
        """Take a message; start a fit if it is time for one and no other fit works."""
        payload, camera = message.payload, str(message.camera)
        if isinstance(payload, Measurement):
            self._entered.append(payload)
        elif isinstance(payload, Markers) and camera in self._markers:
            self._add(camera, payload)
        self._next_ns = self._next_ns or message.log_time_ns + self._every_ns
        if message.log_time_ns >= self._next_ns and (self._fitting is None or self._fitting.done()):
            self._raise_bug()
            self._next_ns = message.log_time_ns + self._every_ns
            self._fitting = self._worker.submit(self._report)

    def close(self) -> None:
        """Wait for the fit that works, and start no other."""
        self._worker.shutdown(cancel_futures=True)
        self._raise_bug()

    def _raise_bug(self) -> None:
        """Raise the exception of the last fit, which is a bug: other errors of a fit are lines."""
        if self._fitting is not None and not self._fitting.cancelled():
            self._fitting.result()

    def _add(self, camera: str, markers: Markers) -> None:
        kept = self._markers[camera]
        if not kept or markers.timestamp - kept[-1].timestamp >= _STEP_NS:
            kept.append(markers)
        size_px = np.array([markers.width, markers.height])
        for marker in markers.markers:
            x, y = np.clip(marker.corners_px.mean(axis=0) / size_px * _CELLS, 0, np.array(_CELLS) - 1)
            self._cells[camera][int(x), int(y)] = True

    def _report(self) -> None:
        active = active_measurements(list(self._entered))
        if len(active) < 2:
            shares = ", ".join(f"{camera} {cells.mean():.0%}" for camera, cells in self._cells.items())
            self._say(f"markers were in these parts of the images: {shares}; measured points: {len(active)}")
            return
        try:
            self.lab = self._fit(active)
        except (IpsysError, np.linalg.LinAlgError) as error:
            self._say(f"no fit yet: {error}")
            return
        self._say(_line(self.lab))

    def _fit(self, active: list[Measurement]) -> LabCalibration:
        nominal = {camera for camera, lens in self._lenses.items() if is_nominal(lens)}
        markers = {camera: list(seen) for camera, seen in self._markers.items()}
        baselines = active_baselines(list(self._entered))
        observations = gather_observations(
            self._rig, self._lenses, markers, active, nominal, baselines=baselines
        )
        fit = fit_without(observations, ())
        frames = ((camera, frame) for camera, seen in markers.items() for frame in seen)
        contradictions = [*find_contradicted_inputs(frames, self._lenses, self._rig)]
        names = sorted(markers)
        return describe_fit(fit, names, "joint", self._rig, self._lenses, self._goal_m, contradictions)


def _line(lab: LabCalibration) -> str:
    """Return the expected error of each camera, and the next step, on one line."""
    errors = ", ".join(f"{one.camera} {one.mean_m * MM_PER_M:.1f}" for one in lab.cameras)
    text = f"expected mean error in mm: {errors}"
    if lab.causes:
        return f"{text}; {lab.causes[0]}"
    if lab.is_enough:
        return f"{text}; enough: Ctrl-C ends the recording"
    if lab.missing:
        return f"{text}; drive through the view of {', '.join(lab.missing)}"
    if lab.gap is not None:
        x_cm, y_cm = (100 * (lab.gap.low_m + lab.gap.high_m) / 2).round().astype(int).tolist()
        return f"{text}; drive through x {x_cm}, y {y_cm} cm"
    if lab.points:
        x_cm, y_cm = (100 * lab.points[0].point_m).round().astype(int).tolist()
        return f"{text}; tape a point near x {x_cm}, y {y_cm} cm"
    return f"{text}; the goal is {lab.goal_m * MM_PER_M:g} mm: drive longer"
