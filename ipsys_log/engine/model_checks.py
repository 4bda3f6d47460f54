"""Checks of measurements and models before any computation, and remarks on a stage while it runs."""

from array import array
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from math import hypot
from statistics import median

import numpy as np
from numpy.typing import NDArray

from ipsys_log.engine.graph import Task
from ipsys_log.engine.provenance import complete_runs, newest_run, replaced_lenses
from ipsys_log.engine.request import LEAST_OFFSET_PX, MIN_OFFSETS, Request, copied_run, fitted_in, has_corners
from ipsys_log.engine.view import LogView
from ipsys_log.errors import FitError, IpsysError
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import CameraCalibration, Event, Markers, Message, Model, Positions, Rig, kind_of
from ipsys_log.messages.channels import CAMERA_POINTS, EVALUATION, MARKERS, POSITIONS, RIG, Channel
from ipsys_log.messages.events import CONTRADICTIONS
from ipsys_log.models.table import needs_height
from ipsys_log.plain_text import shell_words
from ipsys_log.statistics.calibration_points import measured, split_ids, training_pairs
from ipsys_log.statistics.model_kinds import can_evaluate, joint_models, model_kind
from ipsys_log.statistics.tape import RiggedMeasurement, world_point
from ipsys_log.units import CM_PER_M, format_time


def check_measurements(session: Session, request: Request, models: Sequence[str]) -> None:
    """Check that the measurements are valid, and enough to fit the models."""
    places = measured(LogView(session, rig=request.rig))
    if not places and all(copied_run(session, model) for model in models):
        return
    if not places:
        raise FitError(
            f"{session}: has no measurements to fit a model to; enter some with "
            f"'ipsys measure {shell_words(session.paths[-1])}', or apply a model of another log with "
            "--model-from calibration.mcap"
        )
    train, _ = split_ids([place.measurement for place in places], request.options())
    world_m = _check_places(places)
    train_m = np.array([world_m[name] for name in sorted(train)]).reshape(-1, 3)
    for model in models:
        model_kind(model).check_points(model, str(session), train_m, has_corners(session))


def _check_places(places: Sequence[RiggedMeasurement]) -> dict[str, NDArray[np.float64]]:
    """Return the world points (3,) in m of valid measurements, by id."""
    world_m = {}
    for place in places:
        world_m[place.measurement.id] = world_point(place.measurement, place.rig).world_m
        marker_id = place.measurement.marker_id
        if marker_id is not None and not place.rig.knows(marker_id):
            known = ", ".join(str(marker.id) for marker in place.rig.markers)
            raise IpsysError(
                f"measurement {place.measurement.id} names marker {marker_id}, which is not in the rig "
                f"(it has {known}); correct lab.toml and give it with --rig"
            )
    return world_m


def check_fits(
    session: Session, request: Request, inputs: Mapping[Channel, str], models: Sequence[str]
) -> None:
    """Check that models can be fitted to the camera points of a run, before the first model is fitted.

    Raises
    ------
    IpsysError
        A camera sees too few calibration points for a model, or a measured marker was never seen.
    """
    view = LogView(session, inputs, request.rig)
    train, _ = split_ids([point.measurement for point in measured(view)], request.options())
    pairs = training_pairs(view, train)
    for model in models:
        model_kind(model).check_pairs(model, pairs)


def check_evaluated(session: Session, request: Request, models: Sequence[str]) -> None:
    """Check the measurements on which a model of another log is evaluated."""
    view = LogView(session, rig=request.rig)
    if any(can_evaluate(view, request.options(), model) for model in models):
        _check_places(measured(view))


def check_models(
    session: Session, request: Request, models: Sequence[str], written: Collection[Channel], cameras: set[str]
) -> list[str]:
    """Check that the other log has the models, and that they can be applied if a stage applies them.

    Returns
    -------
    One line for each difference of the rigs.
    """
    assert request.model_from is not None
    if not cameras:
        run = newest_run(session, CAMERA_POINTS)
        cameras = {str(camera_of_topic(topic)) for topic in session.topics(CAMERA_POINTS, run)}
    with Session([request.model_from]) as other:
        fitted_models = [fitted_in(other, name)[0] for name in models]
        for model in fitted_models:
            if {EVALUATION, POSITIONS} & {*written}:
                model_kind(model.name).restore(model)
            fitted = {camera.camera for camera in model.cameras}
            if POSITIONS in written and not fitted & cameras:
                raise IpsysError(
                    f"--model-from {request.model_from}: its model is for the cameras "
                    f"{', '.join(sorted(fitted))}, but the log has {', '.join(sorted(cameras))}; give a "
                    "model of these cameras"
                )
    lenses = {name: session.payloads([topic])[-1] for name, topic in session.calibrations.items()}
    rig = request.rig or next(iter(session.payloads(session.topics(RIG))[-1:]), None)
    return compare_labs(request.model_from, fitted_models, rig, {**lenses, **request.lenses})


# Two cameras of one type differ by about 1 % in focal length; another lens or another crop by more.
_MOST_FOCAL_CHANGE = 0.03
# Smaller differences are corrections of the same lab.
_MOST_POINT_CHANGE_M, _MOST_SIDE_CHANGE = 0.02, 0.01


def compare_labs(
    model_from: LogLocation, models: Iterable[Model], rig: Rig | None, lenses: Mapping[str, CameraCalibration]
) -> list[str]:
    """Compare a lab with that of some models; return one line for each difference of the rigs.

    A camera has the lens of a model if its focal length is that of the log, of intrinsics that replaced those
    of the log in a run, or of the estimate of a joint model.

    Parameters
    ----------
    model_from, models : the log with the models, and those to apply.
    rig, lenses : those of the present lab; its intrinsics by camera.

    Raises
    ------
    IpsysError
        A camera has another lens, or other images: the model gives wrong positions.
    """
    with Session([model_from]) as other:
        recorded = {camera: other.payloads([topic])[-1] for camera, topic in other.calibrations.items()}
        replaced = [replaced_lenses(run) for run in complete_runs(other)]
        rigs = other.payloads(other.topics(RIG))[-1:]
    estimates = [joint_models(model) for model in models]
    for camera in sorted(recorded.keys() & lenses.keys()):
        width = recorded[camera].width
        used = [recorded[camera], *(by_camera[camera] for by_camera in replaced if camera in by_camera)]
        focals = [float(lens.K[0, 0] / lens.width) for lens in used]
        focals += [float(joint[camera].lens[0] / width) for joint in estimates if camera in joint]
        own = float(lenses[camera].K[0, 0] / lenses[camera].width)
        if min(abs(own / focal - 1) for focal in focals) > _MOST_FOCAL_CHANGE:
            raise IpsysError(
                f"camera {camera}: its focal length is {own:.3f} image widths, but {focals[-1]:.3f} in "
                f"{model_from}: this is a model of other cameras; calibrate this lab, and give its log to "
                "--model-from"
            )
    if rig is None or not rigs:
        return []
    lines = []
    places_m = {point.name: point for point in rigs[0].reference_points}
    for point in rig.reference_points:
        twin = places_m.get(point.name)
        shift_m = 0.0 if twin is None else hypot(point.x_m - twin.x_m, point.y_m - twin.y_m)
        if shift_m > _MOST_POINT_CHANGE_M:
            lines.append(
                f"reference point {point.name} is {shift_m * CM_PER_M:.1f} cm from its place in "
                f"{model_from}: positions are in the coordinates of that log"
            )
    own_m, recorded_m = rig.marker_length_m, rigs[0].marker_length_m
    if abs(own_m / recorded_m - 1) > _MOST_SIDE_CHANGE:
        lines.append(
            f"marker_length_m is {own_m:g}, but {recorded_m:g} in {model_from}: check it with a ruler, or "
            "give a model of this lab"
        )
    return lines


def check_heights(session: Session, request: Request, models: Sequence[str]) -> None:
    """Check that the rig has a height for each marker, if a model needs the heights of markers."""
    rigs = [request.rig] if request.rig is not None else session.payloads(session.topics(RIG))
    for name in models:
        for rig in rigs:
            missing = rig.without_height()
            if needs_height(name) and (missing or (not rig.markers and rig.marker_height_m is None)):
                which = f"marker {missing[0]}" if missing else "the markers"
                raise IpsysError(
                    f"{session}: {name} needs the height of {which} above the floor: write marker_height_m "
                    "into lab.toml ('ipsys init lab.toml --from LOG' writes the rig of the log), and "
                    "give the file with --rig"
                )


def check_evaluation(session: Session, request: Request, models: Sequence[str]) -> None:
    """Check that the log has points to evaluate a model on."""
    view = LogView(session, rig=request.rig)
    if not any(can_evaluate(view, request.options(), model) for model in models):
        raise IpsysError(
            f"{session}: has no held-out points, and its {len(measured(view))} calibration points are too "
            "few for cross-validation; label some 'test', or measure more"
        )


class Remarks:
    """Collector of remarks; it sees all messages of a stage on their way into the log."""

    def __init__(self, task: Task, skip_ambiguous: bool) -> None:
        self._task = task
        self._skip_ambiguous = skip_ambiguous
        # For each kind of event: the number of events, and the first event.
        self._events: Counter[str] = Counter()
        self._first: dict[str, Message] = {}
        self._unknown: set[str] = set()
        self._contradictions: list[Message] = []
        self._frames = self._markers = 0
        self._located: set[str | None] = set()
        # An array takes eight bytes for each offset: a long log has millions of offsets.
        self._offsets_px: dict[str, array[float]] = {}

    def watch(self, messages: Iterable[Message]) -> Iterator[Message]:
        """Yield the messages, unchanged.

        Raises
        ------
        IpsysError
            A marker is ambiguous, no frame can be decoded, or no frame shows a marker of the rig that can be
            measured.
        """
        for message in messages:
            self._note(message)
            yield message
        if MARKERS in self._task.stage.writes:
            self._check_detection()

    def _note(self, message: Message) -> None:
        payload = message.payload
        if isinstance(payload, Event) and payload.kind in CONTRADICTIONS:
            self._contradictions.append(message)
        elif isinstance(payload, Event):
            self._events[payload.kind] += 1
            self._first.setdefault(payload.kind, message)
            if payload.kind == "unknown_marker":
                self._unknown.add(str(payload.marker_id))
            if payload.kind == "ambiguous_marker" and not self._skip_ambiguous:
                raise IpsysError(
                    f"{_said(message)}: give each marker its own id, or exclude the marker from such frames "
                    "with --skip-ambiguous"
                )
        elif isinstance(payload, Markers):
            self._frames += 1
            self._markers += len(payload.markers)
            offsets = self._offsets_px.setdefault(str(message.camera), array("d"))
            offsets.extend(m.edge_offset_px for m in payload.markers if m.edge_offset_px is not None)
        elif kind_of(payload) is Positions:
            self._located.add(message.camera)

    def _check_detection(self) -> None:
        corrupt = self._events["corrupt_frame"]
        if corrupt and not self._frames:
            first = _said(self._first["corrupt_frame"])
            raise IpsysError(f"none of {corrupt} frames can be decoded, first: {first}")
        if self._contradictions and not self._markers:
            first = _said(self._contradictions[0])
            raise IpsysError(f"no marker could be measured in {self._frames} frames: {first}")
        if self._unknown and not self._markers:
            raise IpsysError(
                "no frame has a marker of the rig, but the frames have ids "
                f"{', '.join(sorted(self._unknown))}: add them as [[markers]] to lab.toml, and give the "
                "file with --rig"
            )
        rejected = self._events["rejected_marker"]
        if rejected and not self._markers:
            raise IpsysError(
                f"no marker could be measured in {self._frames} frames, first: "
                f"{_said(self._first['rejected_marker'])}: change the light, move the marker, or print it on "
                "matt paper"
            )
        if self._frames and not self._markers:
            raise IpsysError(
                f"no marker was found in {self._frames} frames: check that the markers are printed from the "
                "dictionary of the rig (or give another rig with --rig), completely visible, in focus and "
                "without glare"
            )

    def lines(self) -> tuple[str, ...]:
        """Return one line for each remark."""
        lines = [
            f"{count} x {kind.replace('_', ' ')}, first: {_said(self._first[kind])}"
            for kind, count in sorted(self._events.items())
        ]
        lines = [*map(_said, self._contradictions), *lines]
        if MARKERS in self._task.stage.writes:
            lines.insert(0, f"{self._markers} markers in {self._frames} frames")
            lines += self._about_offsets()
        if POSITIONS in self._task.stage.writes:
            cameras = {camera_of_topic(topic) for topic in self._task.topics} - {None}
            lines += [f"camera {name} has no model" for name in sorted(map(str, cameras - self._located))]
        return (*lines, *self._task.notes)

    def _about_offsets(self) -> list[str]:
        medians = {
            c: median(offsets_px)
            for c, offsets_px in self._offsets_px.items()
            if len(offsets_px) >= MIN_OFFSETS
        }
        return [
            f"camera {camera}: black edges are {offset_px:.2f} px inside the black (gamma); corrected"
            for camera, offset_px in sorted(medians.items())
            if abs(offset_px) >= LEAST_OFFSET_PX
        ]


def _said(message: Message) -> str:
    return f"{message.payload.text}, at {format_time(message.log_time_ns)} ({message.log_time_ns} ns)"
