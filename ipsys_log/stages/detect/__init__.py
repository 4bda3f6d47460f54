"""The stage *detect*: frames to markers, tracked and fitted at their edges, or as in the paper."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from ipsys_log.errors import FrameError, IpsysError, SizeError
from ipsys_log.messages import (
    CameraCalibration,
    Color,
    CompressedVideo,
    Event,
    ImageAnnotations,
    Marker,
    Markers,
    Message,
    Point2,
    PointsAnnotation,
    Rig,
    RigCamera,
    SkippedVideo,
    TextAnnotation,
)
from ipsys_log.messages.channels import ANNOTATIONS, CALIBRATIONS, EVENTS, IMAGES, MARKERS, RIG, RUN_EVENTS
from ipsys_log.messages.events import skipped_frames
from ipsys_log.messages.stage import Pieces, Plan, Resets, Stage, StageView
from ipsys_log.stages.detect.adjustment import MarkerFit
from ipsys_log.stages.detect.follow import MarkerTracker
from ipsys_log.stages.detect.misprints import Inspection, Misprints
from ipsys_log.stages.detect.reports import (
    NO_KEYFRAME,
    REJECTED_MARKER,
    UNKNOWN_MARKER,
    LensInUse,
    OtherPrints,
    OtherSize,
    Reports,
    SeenSquares,
)
from ipsys_log.stages.detect.search import detect_markers, marker_detector
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.decode import decode_grey
from ipsys_log.vision.lenses import check_calibration, check_size, same_intrinsics
from ipsys_log.vision.video import Video

EDGES, STOCK = CORNERS = ("edges", "stock")

# Shorter periods cost more searches of whole images; longer ones keep fewer processes busy.
_RESET_PERIOD_S = 30
_LONGEST_PERIOD_S = 86_400

_GREEN = Color(0.1, 0.9, 0.3, 1.0)


class FrameDetector:
    """The detection in frames of all cameras, with a memory that ends at each reset.

    It yields for a frame its :class:`Markers` and their drawing for viewers. Markers that a node has detected
    pass unchanged. It yields an :class:`Event` for
    a frame that cannot be decoded, :class:`OtherSize` for a frame of another size than the calibration, and
    :class:`OtherPrints` for prints that are no markers of the rig.
    It leaves out a marker id that is seen twice in a frame or is not in the rig; an event names the id.
    Another event names a marker of the rig that is seen and cannot be measured.

    Parameters
    ----------
    corners : ``edges``, fitted to the edges of the print with the lens distortion, tracked over frames; or
        ``stock``, OpenCV's detector on each frame, refined as the authors do.
    resets : the instants at which the tracking of a camera begins anew; None: never.

    Raises
    ------
    IpsysError
        A frame comes before the rig or, with ``edges``, before the calibration of its camera.
    """

    def __init__(self, corners: str = EDGES, resets: Resets | None = None) -> None:
        self._corners = check_corners(corners)
        self._resets = resets
        self._rig: Rig | None = None
        self._lenses: dict[str | None, CameraCalibration] = {}
        self._following: dict[str | None, MarkerTracker] = {}
        self._inspections: dict[str | None, Inspection] = {}
        self._reset_numbers: dict[str | None, int] = {}
        self._videos: dict[str | None, Video] = {}
        self._lenses_in_use: dict[str | None, LensInUse] = {}

    def __call__(self, message: Message) -> Iterator[Any]:
        payload = message.payload
        if isinstance(payload, Rig):
            self._rig = payload
            # Each dictionary is loaded once at this point: a wrong name is an error before the first frame.
            marker_detector(payload.dictionary)
            self._following.clear()
        elif isinstance(payload, CameraCalibration):
            lens = check_calibration(payload, f"calibration of {message.camera}")
            known = self._lenses.get(message.camera)
            self._lenses[message.camera] = lens
            if known is None or not same_intrinsics(known, lens):
                self._following.pop(message.camera, None)
        elif isinstance(payload, SkippedVideo):
            with suppress(FrameError):
                self._video(message.camera, payload.frame).skip(payload.frame)
        elif isinstance(payload, Markers):
            yield from self._new_lens(message)
            yield payload
        elif not isinstance(payload, Event):  # events only tell which frames a replay ``as_live`` skips
            yield from self._frame(message)

    def _frame(self, message: Message) -> Iterator[Any]:
        if self._rig is None:
            raise IpsysError(
                "the log has no rig (marker dictionary and length): give one with --rig lab.toml"
            )
        try:
            if isinstance(message.payload, CompressedVideo):
                picture = self._video(message.camera, message.payload)(message.payload)
                if picture is None:
                    text = f"{message.topic}: begins before a keyframe; up to that there are no pictures"
                    yield Event(message.publish_time_ns, NO_KEYFRAME, text, message.camera)
                    return
                message = replace(message, payload=picture)
            markers_in_frame, misprints, width, height = self._find(message, self._rig)
        except FrameError as error:
            text = f"{message.topic}: corrupt frame: {error}"
            yield Event(message.publish_time_ns, "corrupt_frame", text, message.camera)
            return
        except SizeError as error:
            yield self._other_size(message, str(error))
            return
        markers, events = sift_markers(markers_in_frame, self._rig, message)
        yield from events
        yield from self._new_lens(message)
        yield from self._squares(message, self._rig)
        if misprints is not None:
            yield _other_prints(message, misprints, markers)
        yield from self._rejections(message, self._rig)
        yield Markers(message.publish_time_ns, markers, width, height)
        yield _drawing(message.publish_time_ns, markers)

    def _other_size(self, message: Message, error: str) -> OtherSize:
        text = f"{message.topic}: a frame is left out: {error}"
        event = Event(message.publish_time_ns, "wrong_size", text, message.camera)
        lens = self._lenses[message.camera]
        return OtherSize(event, error, (lens.width, lens.height))

    def _video(self, camera: str | None, frame: CompressedVideo) -> Video:
        """Return the decoder of a camera; it must get all frames of the camera, and no reset clears it."""
        if camera not in self._videos:
            self._videos[camera] = Video(frame.format)
        return self._videos[camera]

    def _find(self, message: Message, rig: Rig) -> tuple[list[Marker], Misprints | None, int, int]:
        """Return the markers in a frame, other prints, and its width and height."""
        camera = rig.camera(str(message.camera))
        self._reset(message)
        if self._corners == STOCK:
            grey = decode_grey(message.payload)
            height, width = grey.shape
            if message.camera in self._lenses:
                check_size(self._lenses[message.camera], width, height, message.camera)
            markers = detect_markers(grey, rig.dictionary)
            inspect = self._inspections.setdefault(message.camera, Inspection())
            misprints = inspect(grey, rig.dictionary, [marker.corners_px for marker in markers])
        else:
            if message.camera not in self._following:
                self._following[message.camera] = self._follow(message, rig, camera)
            follow = self._following[message.camera]
            fits, width, height = follow(message.payload, message.publish_time_ns)
            markers, misprints = [_marker(fit) for fit in fits], follow.misprints
        return [_timed(marker, camera) for marker in markers], misprints, width, height

    def _reset(self, message: Message) -> None:
        """Forget the markers of a camera at the first frame after a reset."""
        if self._resets is None:
            return
        number = self._resets.number(str(message.camera), message.log_time_ns)
        if self._reset_numbers.get(message.camera) != number:
            self._following.pop(message.camera, None)
            self._lenses_in_use.pop(message.camera, None)
            self._inspections.pop(message.camera, None)
            self._reset_numbers[message.camera] = number

    def _follow(self, message: Message, rig: Rig, camera: RigCamera) -> MarkerTracker:
        lens = self._lenses.get(message.camera)
        if lens is None:
            raise IpsysError(
                f"camera {message.camera} has no calibration in the log, but the corner method edges needs "
                f"one: give it with --calibration {message.camera}=calibration.yaml, or use --corners stock"
            )
        row_time_s = (camera.row_time_ns or 0) / NS_PER_S
        number = rig.cameras.index(camera) if camera in rig.cameras else 0
        return MarkerTracker(
            *(rig.dictionary, lens, camera.edge_offset_px, row_time_s, number, message.camera),
            is_thorough=self._resets is not None,
            ids=frozenset(marker.id for marker in rig.all_markers) if rig.markers else None,
        )

    def _new_lens(self, message: Message) -> Iterator[LensInUse]:
        """Yield the intrinsics of a frame, if they are new since the last reset."""
        lens, used = self._lenses.get(message.camera), self._lenses_in_use.get(message.camera)
        if lens is not None and (used is None or used.lens is not lens):
            self._lenses_in_use[message.camera] = LensInUse(lens)
            yield self._lenses_in_use[message.camera]

    def _squares(self, message: Message, rig: Rig) -> Iterator[SeenSquares]:
        """Yield the raw corners of new markers of the rig."""
        following = self._following.get(message.camera)
        squares = [s for s in following.squares if rig.knows(s.id)] if following is not None else []
        if squares:
            corners_px = np.concatenate([square.corners_px.ravel() for square in squares])
            yield SeenSquares(tuple(square.id for square in squares), tuple(corners_px.tolist()))

    def _rejections(self, message: Message, rig: Rig) -> Iterator[Event]:
        """Yield events for markers that are seen and cannot be measured."""
        following = self._following.get(message.camera)
        for marker in following.rejections if following is not None else ():
            if rig.knows(marker.id):
                text = f"{message.topic}: marker {marker.id} is seen and not measured: {marker.reason}"
                yield Event(message.publish_time_ns, REJECTED_MARKER, text, message.camera, marker.id)


class Detect:
    """The stage *detect*, one for all cameras: detection in frames, with each event reported once.

    The parameters are those of :class:`FrameDetector`.

    Raises
    ------
    IpsysError
        As :class:`FrameDetector`; or the first frame of a camera has another size than its calibration.
    """

    def __init__(self, corners: str = EDGES, resets: Resets | None = None) -> None:
        self._detector = FrameDetector(corners, resets)
        self._reports = Reports()

    def __call__(self, message: Message) -> Iterator[Any]:
        yield from self._reports(message.camera, self._detector(message))


def check_corners(name: str) -> str:
    """Return the name of a corner method, if there is such a method.

    Raises
    ------
    IpsysError
        There is no such method.
    """
    if name not in CORNERS:
        raise IpsysError(f"--corners {name}: is not known; use one of {', '.join(CORNERS)}")
    return name


def _marker(fit: MarkerFit) -> Marker:
    # In single precision, as in the log: the next stages must read the same numbers from both.
    covariance_px2 = fit.covariance_px2.astype(np.float32).astype(np.float64)
    return Marker(fit.pose.id, fit.corners_px, covariance_px2, edge_offset_px=fit.edge_offset_px)


def _timed(marker: Marker, camera: RigCamera) -> Marker:
    """Return a marker with its time offset: exposure of its row minus that of the first (rolling shutter)."""
    if camera.row_time_ns is None:
        return marker
    row = float(marker.corners_px[:, 1].mean())
    return replace(marker, time_offset_ns=round(row * camera.row_time_ns))


def sift_markers(
    found: Sequence[Marker], rig: Rig, message: Message
) -> tuple[tuple[Marker, ...], list[Event]]:
    """Leave out ambiguous and unknown markers; return the other markers, and an event for each id."""
    counts = Counter(marker.id for marker in found)
    events = []
    for marker_id, count in sorted(counts.items()):
        if not rig.knows(marker_id):
            kind, text = UNKNOWN_MARKER, f"marker {marker_id} is not in the rig"
        elif count > 1:
            kind, text = "ambiguous_marker", f"marker {marker_id} is seen {count} times in one frame"
        else:
            continue
        events.append(
            Event(message.publish_time_ns, kind, f"{message.topic}: {text}", message.camera, marker_id)
        )
    left_out = {event.marker_id for event in events}
    return tuple(marker for marker in found if marker.id not in left_out), events


def _other_prints(message: Message, misprints: Misprints, markers: Iterable[Marker]) -> OtherPrints:
    text = f"{message.topic}: {misprints.advice}"
    event = Event(message.publish_time_ns, misprints.kind, text, message.camera)
    own = tuple(marker.id for marker in markers)
    return OtherPrints(event, misprints.ids, own, misprints.symmetric)


def _drawing(time_ns: int, markers: tuple[Marker, ...]) -> ImageAnnotations:
    """Return outlines and ids for viewers.

    Foxglove counts pixels from the first pixel's corner, OpenCV from its centre.
    """
    shifted = [(marker.id, marker.corners_px + 0.5) for marker in markers]
    return ImageAnnotations(
        points=tuple(
            PointsAnnotation(time_ns, 2, tuple(Point2(float(x), float(y)) for x, y in corners), _GREEN, 2.0)
            for _, corners in shifted
        ),
        texts=tuple(
            TextAnnotation(time_ns, Point2(float(corners[0, 0]), float(corners[0, 1])), str(n), 16.0, _GREEN)
            for n, corners in shifted
        ),
    )


def usual_corners(cameras: Iterable[str], with_lens: Collection[str]) -> str:
    """Return the corner method that is used if none is named: edges if all cameras have intrinsics."""
    return EDGES if set(cameras) <= set(with_lens) else STOCK


def _plan(view: StageView, options: Mapping[str, str]) -> Plan | str:
    if not view.cameras and not view.run(MARKERS):
        return view.newest(MARKERS)
    corners = options.get("corners") or usual_corners(view.cameras, view.lenses)
    skipped = skipped_frames(view.payloads(EVENTS))
    as_live = "as_live" in options and bool(skipped)
    without = sorted(set(view.cameras) - set(view.lenses))
    notes = [] if options.get("corners") else [_why_stock(name) for name in without]
    if skipped and not as_live:
        notes.append(
            f"the new run includes {len(skipped)} frames that live processing skipped; --as-live excludes "
            "them"
        )
    resets = _resets(options)
    period = {} if corners == STOCK else {"reset_s": str(resets.period_ns // NS_PER_S)}
    return Plan(
        run=corners,
        parameters={"corners": corners, **period, **({"as_live": "yes"} if as_live else {})},
        reads=(
            RIG,
            *([CALIBRATIONS] if view.lenses else []),
            *([EVENTS] if as_live else []),
            *([MARKERS] if view.run(MARKERS) else []),
            IMAGES,
        ),
        step=lambda run: _make_step(corners, resets),
        notes=notes,
    )


def _make_step(corners: str, resets: Resets) -> Detect:
    import scipy.special  # noqa: F401 - before the first frame, which must not wait for it

    return Detect(corners, resets)


def _resets(options: Mapping[str, str]) -> Resets:
    """Return the resets with the period of a recorded run, or with the usual period."""
    text = options.get("reset_s", str(_RESET_PERIOD_S))
    period_s = int(text) if text.isascii() and text.isdigit() and len(text) <= len("86400") else 0
    if not 0 < period_s <= _LONGEST_PERIOD_S:
        raise IpsysError(
            f"the record of a run has the parameter reset_s = {text!r}, which is no period from 1 to "
            f"{_LONGEST_PERIOD_S} s; run 'ipsys replay' to compute a new run"
        )
    return Resets(period_s * NS_PER_S)


def _pieces(parameters: Mapping[str, str]) -> Pieces:
    """Return how the frames of a camera between two resets are processed alone."""
    resets = _resets(parameters)
    return Pieces(resets, lambda: FrameDetector(parameters["corners"], resets), Reports)


def _why_stock(camera: str) -> str:
    return (
        f"camera {camera} has no calibration, so its corners are from --corners stock, ten times less "
        f"accurate than with --calibration {camera}=calibration.yaml"
    )


def _rig_part(rig: Rig, _method: str) -> object:
    shutters = {(camera.name, camera.row_time_ns, camera.edge_offset_px) for camera in rig.cameras}
    ids = {m.id for m in rig.markers}, {m.id for m in rig.reference_markers if rig.markers}
    return rig.dictionary, ids, {shutter for shutter in shutters if any(shutter[1:])}


STAGE = Stage(
    name="detect",
    versions={"detect": 3, EDGES: 3, STOCK: 2},
    reads=(RIG, CALIBRATIONS, IMAGES, EVENTS, MARKERS),
    writes=(MARKERS, ANNOTATIONS, RUN_EVENTS),
    plan=_plan,
    rig_part=_rig_part,
    method=lambda parameters, view: parameters.get("corners", ""),
    in_threads=True,
    pieces=_pieces,
)
