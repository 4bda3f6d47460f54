"""Import of tables (CSV) and bags: calibration points, and detected markers as a run of a log."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ipsys_log.engine.output import append_run, open_target
from ipsys_log.engine.provenance import check_run_name, fingerprint, free_name, next_number
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.calibration_files import announce_assumed
from ipsys_log.exchange.image_folders import parse_time
from ipsys_log.exchange.lab_files import load_lenses
from ipsys_log.exchange.row_files import NamedRow, read_named_rows
from ipsys_log.extras import check_installed
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    IMPORTED,
    MEASUREMENTS_TOPIC,
    RIG_TOPIC,
    CameraCalibration,
    CameraPoint,
    CameraPoints,
    Event,
    Interval,
    Marker,
    Markers,
    Measurement,
    Message,
    Rig,
    Run,
    WorldPoint,
    calibration_topic,
)
from ipsys_log.messages.channels import CAMERA_POINTS, MARKERS, RECORD, RIG, RUN_EVENTS
from ipsys_log.messages.rig_file import check_name
from ipsys_log.plain_text import shell_words
from ipsys_log.stages.detect import sift_markers
from ipsys_log.stages.detect.reports import LensInUse, Reports
from ipsys_log.units import NS_PER_S

_CAMERA_AXES = ("xc_m", "yc_m", "zc_m")
_WORLD_AXES = ("xw_m", "yw_m", "zw_m")
_PAIR_COLUMNS = ("id", "camera", *_CAMERA_AXES, *_WORLD_AXES)
_FARTHEST_M = 10_000.0
# A table has no times, so each calibration point gets a second.
_START_NS = 1_577_836_800 * NS_PER_S  # 2020-01-01


class _Point(NamedTuple):
    """The properties of a calibration point that all its rows share."""

    marker_id: int
    world_m: tuple[float, float, float]
    splits: tuple[str, ...]
    calibration_point: str | None


@dataclass(frozen=True, slots=True)
class PairTable:
    """The calibration points of a table by id, and their camera points in m by id and camera."""

    points: dict[str, _Point] = field(default_factory=dict)
    camera_m: dict[str, dict[str, tuple[float, float, float]]] = field(default_factory=dict)

    @property
    def cameras(self) -> dict[str, int]:
        """The number of calibration points by camera."""
        names = sorted({camera for by_camera in self.camera_m.values() for camera in by_camera})
        return {name: sum(name in by_camera for by_camera in self.camera_m.values()) for name in names}


def read_pairs(file: Path, rig: Rig) -> PairTable:
    """Read a table with one row for each camera that saw a calibration point.

    The columns are those of an exported table of pairs: ``id``, ``camera``, ``xc_m yc_m zc_m`` in camera
    coordinates and ``xw_m yw_m zw_m`` in the lab; optional are ``marker_id``, ``splits`` (labels with spaces
    between them: ``train test``) and ``calibration_point``. Without ``marker_id``, the rig must have one
    marker.

    Raises
    ------
    IpsysError
        A cell is wrong, the rig does not know a marker, or the rows of a point contradict each other.
    """
    table = PairTable()
    for row in read_named_rows(file, _PAIR_COLUMNS):
        name = row.text("id")
        if not name:
            raise IpsysError(f"{row.where}: id is empty; name the calibration point")
        camera = check_name(row.text("camera"), f"{row.where}: camera name")
        point = _point(row, rig)
        if table.points.setdefault(name, point) != point:
            raise IpsysError(
                f"{row.where}: calibration point {name!r} has another marker, world point or label in an "
                "earlier row; give it another id"
            )
        seen_m = table.camera_m.setdefault(name, {})
        if camera in seen_m:
            raise IpsysError(f"{row.where}: calibration point {name!r} has a row of camera {camera} already")
        seen_m[camera] = _vector(row, _CAMERA_AXES)
    if not table.points:
        raise IpsysError(f"{file}: has no rows; add a row for each camera that saw a calibration point")
    return table


def pair_messages(table: PairTable, file: Path, rig: Rig) -> Iterator[Message]:
    """Yield the rig, the camera points, the measurements and the record of the import, in log order."""
    time_ns = _START_NS
    yield Message(RIG_TOPIC, time_ns, time_ns, rig)
    for name, point in table.points.items():
        time_ns += NS_PER_S
        for camera, camera_m in sorted(table.camera_m[name].items()):
            points = CameraPoints(time_ns, (CameraPoint(point.marker_id, *camera_m),))
            yield Message(CAMERA_POINTS.topic_of(_RUN, camera), time_ns, time_ns, points, camera)
        yield Message(MEASUREMENTS_TOPIC, time_ns + 1, time_ns, _measurement(name, point, time_ns))
    record = Run(time_ns, _RUN, IMPORTED, {"format": "csv", "file": file.name}, fingerprint(), number=1)
    yield Message(RECORD.topic_of(_RUN), time_ns + 2, time_ns, record)


def _measurement(name: str, point: _Point, time_ns: int) -> Measurement:
    return Measurement(
        timestamp=time_ns,
        id=name,
        marker_id=point.marker_id,
        height_m=point.world_m[2],
        still=Interval(time_ns, time_ns),
        point=WorldPoint(*point.world_m),
        splits=point.splits,
        calibration_point=point.calibration_point,
    )


def _point(row: NamedRow, rig: Rig) -> _Point:
    marker_id = row.optional("marker_id", row.integer)
    if marker_id is None:
        if len(rig.markers) != 1:
            raise IpsysError(f"{row.where}: names no marker; add the column marker_id")
        marker_id = rig.markers[0].id
    if not rig.knows(marker_id):
        raise IpsysError(f"{row.where}: marker {marker_id} is not in the rig; correct the id or the rig")
    return _Point(
        marker_id,
        _vector(row, _WORLD_AXES),
        tuple(row.text("splits").split()),
        row.text("calibration_point") or None,
    )


def _vector(row: NamedRow, names: tuple[str, ...]) -> tuple[float, float, float]:
    x_m, y_m, z_m = (row.number(name) for name in names)
    if max(abs(x_m), abs(y_m), abs(z_m)) > _FARTHEST_M:
        raise IpsysError(
            f"{row.where}: {', '.join(names)}: {x_m:g}, {y_m:g}, {z_m:g} m is impossible in a lab; "
            "convert the lengths to m"
        )
    return x_m, y_m, z_m


_RUN = "imported"
_CORNERS = tuple(f"{axis}{corner}_px" for corner in range(4) for axis in "xy")
_NEEDED = ("time", "camera", "marker_id", *_CORNERS)
_BAGS = (".bag", ".db3", ".mcap")
_RECTIFIED = "camera {} has lens distortion; if the detector read rectified images, give P without distortion"
_LATEST_NS = 1 << 62
_LARGEST_ID = (1 << 31) - 1


@dataclass(frozen=True, slots=True)
class DetectionOptions:
    """The options of an import: a rig for a new log, intrinsics by camera, and the name of the run.

    ``rig_file`` is the path of the rig: the intrinsics of other cameras come from the files that it names.
    ``assumed`` has a text for each camera whose file does not state the lens model; ``topics``, of a bag, the
    topic of each camera.
    """

    rig: Rig | None = None
    lenses: Mapping[str, CameraCalibration] = field(default_factory=dict)
    run: str | None = None
    rig_file: Path | None = None
    assumed: Mapping[str, str] = field(default_factory=dict)
    topics: Mapping[str, str] = field(default_factory=dict)


class ImportedDetections(NamedTuple):
    """The result of an import: the log, its new run, and the number of markers by camera.

    ``lenses`` are the intrinsics from the files of the rig. ``assumed`` is that of the options, with these.
    ``remarks`` name inputs that the markers contradict.
    """

    path: Path
    run: str
    markers: dict[str, int]
    lenses: dict[str, CameraCalibration]
    assumed: dict[str, str]
    remarks: list[str]


def import_detections(
    file: Path, into: Path | None, output: Path | None, options: DetectionOptions
) -> ImportedDetections:
    """Write the detected markers of a table, or of a bag with AprilTag detections, into a run of a log.

    A table has the columns of an exported table of markers (docs/export.md). The intrinsics of a camera give
    the size of its images. Markers of a bag that are unknown or twice in a frame are left out and named.

    Parameters
    ----------
    into : a log without images; it gets the run unless there is an ``output``.
    output : a new log.

    Raises
    ------
    IpsysError
        The file is wrong, a camera has no intrinsics, there is no rig, or the log has images: the stages
        would detect the markers in these. Nothing is written then.
    """
    if into is None and output is None:
        raise IpsysError("no log is named; give --into LOG, or -o LOG for a new one")
    with ExitStack() as stack:
        session = stack.enter_context(Session([into])) if into is not None else None
        if session is not None and session.images:
            raise IpsysError(
                f"{session}: has images, in which ipsys detects the markers itself; import into a part "
                f"without images: "
                f"ipsys cut {shell_words(*session.paths)} -o part.mcap --exclude-topics '/cameras/*/image'"
            )
        rigs = [options.rig] if options.rig else session.payloads(session.topics(RIG)) if session else []
        if not rigs:
            raise IpsysError(f"{session or file}: has no rig; add --rig FILE")
        known = _lenses(session, options.lenses)
        is_bag = file.is_dir() or file.suffix.lower() in _BAGS
        frames = (
            _read_bag(file, options.topics, known, rigs[-1]) if is_bag else _read_table(file, options.topics)
        )
        from_rig, assumed = _lenses_of_rig(options, {frame.camera: frame.where for frame in frames}, known)
        lenses, assumed = {**known, **from_rig}, {**options.assumed, **assumed}
        run = _run_name(session, options.run)
        messages = [_message(frame, lenses[frame.camera], run) for frame in frames]
        messages = [*_reported(messages, lenses, run, rigs[-1] if is_bag else None)]
        texts = [message.payload.text for message in messages if isinstance(message.payload, Event)]
        cameras = sorted({frame.camera for frame in frames})
        texts += [_RECTIFIED.format(camera) for camera in cameras if is_bag and lenses[camera].D.any()]
        if session is None:
            messages = [*announce_assumed(_settings(options.rig, lenses, frames), assumed), *messages]
        last_ns = frames[-1].log_time_ns
        number = 1 if session is None else next_number(session)
        parameters = {"format": "ros" if is_bag else "csv", "file": file.name}
        record = Run(last_ns, run, IMPORTED, parameters, fingerprint(), number=number)
        _, target = stack.enter_context(open_target([into] if into is not None else [], output))
        append_run(target, record, last_ns, lambda: messages, {})
    counts = dict.fromkeys(cameras, 0)
    for message in messages:
        if isinstance(message.payload, Markers):
            counts[str(message.camera)] += len(message.payload.markers)
    return ImportedDetections(output or target, run, counts, from_rig, assumed, [*dict.fromkeys(texts)])


class DetectedFrame(NamedTuple):
    """The markers of a frame, sorted by id, and the place of the frame in errors."""

    log_time_ns: int
    time_ns: int
    camera: str
    markers: tuple[Marker, ...]
    where: str


def _read_bag(file: Path, topics: Mapping[str, str], known: Collection[str], rig: Rig) -> list[DetectedFrame]:
    check_installed("import of ROS bags needs", "rosbags")
    from ipsys_log.exchange.ros_detections import read_bag_detections

    return read_bag_detections(file, topics, {*known, *(camera.name for camera in rig.cameras)}, rig)


def _read_table(file: Path, topics: Mapping[str, str]) -> list[DetectedFrame]:
    """Return the frames of a table in log order, with their markers sorted by id."""
    if topics:
        raise IpsysError("--camera: has no effect for a table; leave it out")
    by_frame: dict[tuple[int, int, str], dict[int, Marker]] = {}
    first_rows: dict[str, str] = {}
    for row in read_named_rows(file, _NEEDED):
        camera = check_name(row.text("camera"), f"{row.where}: camera name")
        first_rows.setdefault(camera, row.where)
        time_ns = _time_ns(row)
        log_ns = row.optional("log_time_ns", row.integer)
        log_ns = time_ns if log_ns is None else log_ns
        if not 0 < log_ns < _LATEST_NS:
            raise IpsysError(f"{row.where}: log_time_ns {log_ns} is not a time in ns since 1970")
        markers = by_frame.setdefault((log_ns, time_ns, camera), {})
        marker = _marker(row)
        if markers.setdefault(marker.id, marker) is not marker:
            raise IpsysError(f"{row.where}: marker {marker.id} is in this frame of {camera} already")
    if not by_frame:
        raise IpsysError(f"{file}: has no rows; export the markers again")
    return [
        DetectedFrame(*key, tuple(markers[one] for one in sorted(markers)), first_rows[key[2]])
        for key, markers in sorted(by_frame.items())
    ]


def _time_ns(row: NamedRow) -> int:
    text = row.text("time")
    try:
        return parse_time(text)
    except ValueError as error:
        raise IpsysError(
            f"{row.where}: time: {text[:40]!r} is not a time; write ISO 8601, or s, ms, us or ns since 1970"
        ) from error


def _marker(row: NamedRow) -> Marker:
    marker_id = row.integer("marker_id")
    if not 0 <= marker_id <= _LARGEST_ID:
        raise IpsysError(f"{row.where}: marker_id {marker_id} is not the id of a marker")
    return Marker(
        marker_id,
        np.array([row.number(name) for name in _CORNERS]).reshape(4, 2),
        time_offset_ns=row.optional("time_offset_ns", row.integer),
        edge_offset_px=row.optional("edge_offset_px", row.number),
    )


def _lenses(session: Session | None, given: Mapping[str, CameraCalibration]) -> dict[str, CameraCalibration]:
    """Return the intrinsics by camera: those of the log, or the given ones."""
    recorded = session.calibrations if session is not None else {}
    own = {camera: session.payloads([topic])[-1] for camera, topic in recorded.items() if session}
    return {**own, **given}


def _lenses_of_rig(
    options: DetectionOptions, rows: Mapping[str, str], known: Mapping[str, CameraCalibration]
) -> tuple[dict[str, CameraCalibration], dict[str, str]]:
    """Return the intrinsics that the rig names for cameras without others, and their assumed models.

    ``rows`` are the places of the first rows by camera.
    """
    cameras = {camera.name: camera for camera in options.rig.cameras} if options.rig else {}
    lenses: dict[str, CameraCalibration] = {}
    assumed: dict[str, str] = {}
    for name in sorted(set(rows) - set(known)):
        if name in cameras and options.rig_file is not None:
            camera = cameras[name]
            lenses |= load_lenses(options.rig_file, [camera], {}, report=assumed.__setitem__)
        if name not in lenses:
            raise IpsysError(
                f"{rows[name]}: camera {name!r} has no intrinsics; add --calibration {name}=FILE, or "
                "calibration = FILE to this camera of the rig file"
            )
    return lenses, assumed


def _reported(
    messages: Sequence[Message], lenses: Mapping[str, CameraCalibration], run: str, rig: Rig | None
) -> Iterator[Message]:
    """Yield frames after the events of their markers. With a rig, leave out unknown and ambiguous markers."""
    reports, topic = Reports(), RUN_EVENTS.topic_of(run)
    for message in messages:
        used, frame, events = LensInUse(lenses[str(message.camera)]), message.payload, list[Event]()
        if rig is not None:
            markers, events = sift_markers(frame.markers, rig, message)
            frame = replace(frame, markers=markers)
        for payload in reports(message.camera, [*events, used, frame]):
            at = topic if isinstance(payload, Event) else message.topic
            yield replace(message, topic=at, payload=payload)


def _run_name(session: Session | None, wanted: str | None) -> str:
    if wanted is not None:
        check_name(wanted, "--run")
    if session is None:
        return wanted or _RUN
    if wanted is not None:
        return check_run_name(session, IMPORTED, wanted, (MARKERS,))
    return free_name(session, Run(0, _RUN, IMPORTED), _RUN, (MARKERS,))


def _settings(
    rig: Rig | None, lenses: Mapping[str, CameraCalibration], frames: Sequence[DetectedFrame]
) -> Iterator[Message]:
    """Yield the rig, and the intrinsics of the cameras with frames, just before the first frame."""
    cameras = sorted({frame.camera for frame in frames})
    log_ns = frames[0].log_time_ns - len(cameras) - 1
    yield Message(RIG_TOPIC, log_ns, log_ns, rig)
    for number, camera in enumerate(cameras, 1):
        time_ns = log_ns + number
        lens = replace(lenses[camera], timestamp=time_ns, frame_id=camera)
        yield Message(calibration_topic(camera), time_ns, time_ns, lens, camera)


def _message(frame: DetectedFrame, lens: CameraCalibration, run: str) -> Message:
    markers = Markers(frame.time_ns, frame.markers, lens.width, lens.height)
    topic = MARKERS.topic_of(run, frame.camera)
    return Message(topic, frame.log_time_ns, frame.time_ns, markers, frame.camera)
