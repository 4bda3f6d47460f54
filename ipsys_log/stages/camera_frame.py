"""Conversion of markers in pixels to points in camera coordinates: eq. (3) to (5), or the square's pose."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import (
    Array,
    CameraCalibration,
    CameraPoint,
    CameraPoints,
    Event,
    Marker,
    MarkerPose,
    Markers,
    Message,
    Rig,
)
from ipsys_log.messages.channels import CALIBRATIONS, CAMERA_POINTS, MARKERS, RIG, RUN_EVENTS
from ipsys_log.messages.events import CALIBRATION_CONTRADICTED, TILTED_MARKER
from ipsys_log.messages.stage import Plan, Stage, StageView
from ipsys_log.statistics.marker_tests import MarkerTilts, SeenMarkers, SizeTest
from ipsys_log.vision.lenses import check_calibration, check_size, undistort
from ipsys_log.vision.markers import (
    camera_point,
    camera_point_slopes,
    check_covariance,
    heading,
    pixel_slopes,
    whiten,
)
from ipsys_log.vision.square_pose import calibration_covariances, fit_squares, is_convex, reprojection_px

PERIMETER = "perimeter"

# For corners without a covariance: OpenCV's corners have an error of about a quarter of a pixel.
_USUAL_PX2 = 0.25**2 * np.eye(8)


class CameraFrame:
    """The stage *camera-frame*: it uses the camera intrinsics and the length of the marker.

    Parameters
    ----------
    method : ``perimeter``, eq. (3) to (5), exact for a marker that is parallel to the image plane; or
        ``pose``, exact for a marker with any tilt. With ``perimeter``, an event names a tilted marker, one
        for each camera. Further events name markers whose sizes contradict the rig.
    """

    def __init__(self, method: str = PERIMETER) -> None:
        self._method = METHODS[check_method(method)]
        self._rig: Rig | None = None
        self._lenses: dict[str | None, CameraCalibration] = {}
        self._knows_tilts = method != PERIMETER
        self._tilts: dict[str | None, MarkerTilts] = {}
        self._sizes: dict[str, SizeTest] = {}

    def __call__(self, message: Message) -> Iterator[Any]:
        payload = message.payload
        if isinstance(payload, Rig):
            self._rig = payload
            self._sizes.clear()
        elif isinstance(payload, CameraCalibration):
            self._sizes.pop(str(message.camera), None)
            self._lenses[message.camera] = check_calibration(payload, f"calibration of {message.camera}")
        else:
            yield from self._frame(payload, message)

    def _frame(self, frame: Markers, message: Message) -> Iterator[Event | CameraPoints]:
        camera, points = message.camera, []
        if camera in self._lenses:
            check_size(self._lenses[camera], frame.width, frame.height, camera)
        if frame.markers:
            rig, lens = self._settings(camera)
            seen: list[_Seen] = []
            robots = [marker for marker in frame.markers if not rig.is_reference(marker.id)]
            for sighting in _through_lens(robots, rig, lens) if robots else ():
                fault = self._fault(sighting, camera)
                if fault is None:
                    seen.append(sighting)
                else:
                    yield Event(message.publish_time_ns, *fault, camera, sighting.marker.id)
            points = self._method.place(seen, lens) if seen else []
            yield from self._wrong_sizes(frame, str(camera))
            # With nominal intrinsics, which have no distortion, level markers seem to lie on a bowl.
            if seen and not self._knows_tilts and lens.D.any():
                yield from self._tilt(seen, lens, frame.height, message)
        yield CameraPoints(message.publish_time_ns, tuple(points))

    def _wrong_sizes(self, frame: Markers, camera: str) -> Iterator[Event]:
        """Yield an event for each marker whose size contradicts its length and height in the rig."""
        rig, lens = self._settings(camera)
        if camera not in self._sizes:
            self._sizes[camera] = SizeTest(camera, lens, rig)
        for text, marker_id in self._sizes[camera].add(frame.timestamp, frame.markers):
            yield Event(frame.timestamp, CALIBRATION_CONTRADICTED, text, camera, marker_id)

    def _tilt(
        self, seen: Sequence[_Seen], lens: CameraCalibration, rows: int, message: Message
    ) -> Iterator[Event]:
        """Yield the event of a tilted marker, if its tilt has become certain."""
        tilts = self._tilts.setdefault(message.camera, MarkerTilts())
        own = [sighting for sighting in seen if is_convex(sighting.uv)]
        tilted = (
            tilts.add(_seen_markers(own, lens, rows, message.publish_time_ns))
            if tilts.is_next() and own
            else None
        )
        if tilted is not None:
            text = (
                f"camera {message.camera}: marker {tilted.marker_id} is tilted by "
                f"{np.degrees(tilted.tilt_rad):.0f} degrees, but eq. (3) takes it for parallel to the image; "
                "use --method pose"
            )
            yield Event(message.publish_time_ns, TILTED_MARKER, text, message.camera, tilted.marker_id)

    def _settings(self, camera: str | None) -> tuple[Rig, CameraCalibration]:
        if self._rig is None:
            raise IpsysError("the log has no rig (marker length): give one with --rig lab.toml")
        if camera not in self._lenses:
            raise IpsysError(
                f"camera {camera} has no calibration in the log: give one with "
                f"--calibration {camera}=calibration.yaml"
            )
        return self._rig, self._lenses[camera]

    def _fault(self, seen: _Seen, camera: str | None) -> tuple[str, str] | None:
        """Return the reason why a marker gets no camera point, as kind and text of an event."""
        name = f"marker {seen.marker.id}"
        if seen.marker.covariance_px2 is not None:
            check_covariance(seen.marker.covariance_px2, f"{name} of camera {camera}")
        if not np.isfinite(seen.uv).all():
            return "outside_lens", f"{name} lies where the calibration of {camera} has no ray"
        if not self._method.accepts(seen.uv):
            return "no_square", f"the corners of {name} are not those of a square seen from in front"
        return None


class _Seen(NamedTuple):
    """A marker, its corners in normalized image coordinates, (4, 2), and the side of its black square."""

    marker: Marker
    uv: Array
    length_m: float


def _through_lens(markers: Sequence[Marker], rig: Rig, lens: CameraCalibration) -> list[_Seen]:
    # One call for all markers: most of the time of a call does not depend on their number.
    uv = undistort(np.concatenate([marker.corners_px for marker in markers]), lens).reshape(-1, 4, 2)
    lengths_m = [rig.length_of(marker.id) for marker in markers]
    return [_Seen(*row) for row in zip(markers, uv, lengths_m, strict=True)]


def _lens_slopes(seen: Sequence[_Seen], lens: CameraCalibration) -> Array:
    return pixel_slopes(np.concatenate([sighting.uv for sighting in seen]), lens).reshape(-1, 4, 2, 2)


def _by_perimeter(seen: Sequence[_Seen], lens: CameraCalibration) -> list[CameraPoint]:
    uv, lengths_m = np.array([s.uv for s in seen]), np.array([s.length_m for s in seen])
    places = zip(camera_point(uv, lengths_m).tolist(), heading(uv).tolist(), strict=True)
    covariances_m2 = _perimeter_covariances(seen, uv, lengths_m, lens)
    points = []
    for n, ((marker, _, _), ((x_m, y_m, z_m), heading_rad)) in enumerate(zip(seen, places, strict=True)):
        of_marker = heading_rad, marker.time_offset_ns, covariances_m2.get(n), (), marker.contradicted
        points.append(CameraPoint(marker.id, x_m, y_m, z_m, *of_marker))
    return points


def _perimeter_covariances(
    seen: Sequence[_Seen], uv: Array, lengths_m: Array, lens: CameraCalibration
) -> dict[int, Array]:
    """Return covariances (3, 3) in m^2, by index, of the points whose corners have a covariance."""
    covariances = {n: sighting.marker.covariance_px2 for n, sighting in enumerate(seen)}
    known = {n: covariance_px2 for n, covariance_px2 in covariances.items() if covariance_px2 is not None}
    if not known:
        return {}
    indices = list(known)
    by_px = np.linalg.inv(pixel_slopes(uv[indices].reshape(-1, 2), lens)).reshape(-1, 4, 2, 2)
    by_corner = camera_point_slopes(uv[indices], lengths_m[indices]) @ by_px
    m_by_px = by_corner.swapaxes(1, 2).reshape(-1, 3, 8)
    covariances_m2 = m_by_px @ np.array([*known.values()]) @ m_by_px.swapaxes(1, 2)
    return dict(zip(indices, covariances_m2, strict=True))


def _by_pose(seen: Sequence[_Seen], lens: CameraCalibration) -> list[CameraPoint]:
    lengths_m = np.array([sighting.length_m for sighting in seen])
    lens_slopes = _lens_slopes(seen, lens)
    whitening = _whitening(seen, lens_slopes)
    squares = fit_squares(np.stack([sighting.uv for sighting in seen]), whitening, lengths_m)
    covariances_m2 = squares.covariances_m2
    covariances_m2 = covariances_m2 + calibration_covariances(
        squares.centres_m[:, 0], lens_slopes.mean(axis=1)
    )
    corners_px = np.stack([s.marker.corners_px for s in seen])
    misses_px = reprojection_px(squares.rotations, squares.centres_m, lengths_m, corners_px, lens)
    points = []
    for n, (marker, _, _) in enumerate(seen):
        both = zip(squares.centres_m[n].tolist(), squares.rotations[n], misses_px[n].tolist(), strict=True)
        poses = tuple(MarkerPose(x, y, z, _vector(turn), miss_px) for (x, y, z), turn, miss_px in both)
        x_m, y_m, z_m = squares.centres_m[n, 0].tolist()
        # The side from corner 3 to corner 0 is the marker's y axis.
        right, down, _ = squares.rotations[n, 0, :, 1]
        heading_rad = float(np.arctan2(-down, right))
        covariance_m2 = None if marker.covariance_px2 is None else covariances_m2[n]
        of_marker = heading_rad, marker.time_offset_ns, covariance_m2, poses, marker.contradicted
        points.append(CameraPoint(marker.id, x_m, y_m, z_m, *of_marker))
    return points


def _whitening(seen: Sequence[_Seen], lens_slopes: Array) -> Array:
    """Return matrices that turn changes of u0 v0 .. u3 v3 into eight numbers of variance 1, (n, 8, 8)."""
    covariances_px2 = [sighting.marker.covariance_px2 for sighting in seen]
    whitening = whiten(np.stack([_USUAL_PX2 if c is None else c for c in covariances_px2]))
    by_corner = whitening.reshape(-1, 8, 4, 2).swapaxes(1, 2)
    by_marker: Array = (by_corner @ lens_slopes).swapaxes(1, 2).reshape(-1, 8, 8)
    return by_marker


def _seen_markers(seen: Sequence[_Seen], lens: CameraCalibration, rows: int, time_ns: int) -> SeenMarkers:
    covariances_px2 = [sighting.marker.covariance_px2 for sighting in seen]
    traces_px2 = [np.trace(_USUAL_PX2 if c is None else c) for c in covariances_px2]
    # Only edges, whose corners have a covariance, are corrected with the row time of the rig.
    corrected = [s.marker.time_offset_ns is not None and s.marker.covariance_px2 is not None for s in seen]
    return SeenMarkers(
        time_ns,
        [sighting.marker.id for sighting in seen],
        np.stack([sighting.marker.corners_px for sighting in seen]),
        np.stack([sighting.uv for sighting in seen]),
        _whitening(seen, _lens_slopes(seen, lens)),
        np.array([sighting.length_m for sighting in seen]),
        np.sqrt(np.array(traces_px2) / 8),
        ~np.array(corrected),
        rows,
    )


def _vector(rotation: Array) -> Array:
    return np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64).ravel()


class _Method(NamedTuple):
    """A method for camera points: its check of four corners, and its function for the points of a frame."""

    accepts: Callable[[Array], bool]
    place: Callable[[Sequence[_Seen], CameraCalibration], list[CameraPoint]]


METHODS = {
    PERIMETER: _Method(lambda uv: bool((uv != uv[0]).any()), _by_perimeter),
    "pose": _Method(is_convex, _by_pose),
}


def check_method(name: str) -> str:
    """Return the name of a method.

    Raises
    ------
    IpsysError
        There is no method of that name.
    """
    if name not in METHODS:
        raise IpsysError(f"method {name!r} is not known; use one of {', '.join(METHODS)}")
    return name


def points_run(markers: str, method: str) -> str:
    """Return the name of a run of camera points: the run of its markers, with the method."""
    return markers if method == PERIMETER else f"{markers}_{method}"


def _plan(view: StageView, options: Mapping[str, str]) -> Plan | str:
    method = options.get("method", PERIMETER)
    markers = view.run(MARKERS)
    if not markers:
        if method != PERIMETER:
            raise IpsysError(f"--method {method}: has no effect, because the log has no markers")
        return view.newest(CAMERA_POINTS)
    return Plan(
        run=points_run(markers, method),
        # Logs from before this option do not have the parameter.
        parameters={} if method == PERIMETER else {"method": method},
        reads=(RIG, MARKERS, CALIBRATIONS),
        step=lambda run: CameraFrame(method),
    )


def _rig_part(rig: Rig, _method: str) -> object:
    sizes = {(marker.id, rig.length_of(marker.id), rig.height_of(marker.id)) for marker in rig.markers}
    return rig.marker_length_m, sizes, {marker.id for marker in rig.reference_markers}


STAGE = Stage(
    name="camera-frame",
    versions={"camera-frame": 1, PERIMETER: 2, "pose": 2},
    reads=(RIG, CALIBRATIONS, MARKERS),
    writes=(CAMERA_POINTS, RUN_EVENTS),
    plan=_plan,
    rig_part=_rig_part,
    method=lambda parameters, view: parameters.get("method", PERIMETER),
    # An event names a marker once.
)
