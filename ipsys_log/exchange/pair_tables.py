"""Import of calibration points from a CSV table: camera points and world points of each camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from ipsys_log.engine.provenance import fingerprint
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.csv_rows import NamedRow, read_rows
from ipsys_log.messages import (
    IMPORTED,
    MEASUREMENTS_TOPIC,
    RIG_TOPIC,
    CameraPoint,
    CameraPoints,
    Interval,
    Measurement,
    Message,
    Rig,
    Run,
    WorldPoint,
)
from ipsys_log.messages.channels import CAMERA_POINTS, RECORD
from ipsys_log.messages.rig_file import check_name
from ipsys_log.units import NS_PER_S

_RUN = "imported"
_CAMERA_AXES = ("xc_m", "yc_m", "zc_m")
_WORLD_AXES = ("xw_m", "yw_m", "zw_m")
_NEEDED = ("id", "camera", *_CAMERA_AXES, *_WORLD_AXES)
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
    for row in read_rows(file, _NEEDED):
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
