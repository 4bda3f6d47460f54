"""Rendered labs for the benchmark of calibration: the same sessions as without images, through detect."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from scenes import drawn

from ipsys_log.capture.simulation.calibration_points import plan_points
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.request import Request
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Measurement, Message
from ipsys_log.messages.channels import CALIBRATIONS, MARKERS, MEASUREMENTS, RIG
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab

__all__ = ["rendered_lab"]

# With these, a lab has at least 75 points: each camera sees about 33 of them.
_STATIONS = 33


def rendered_lab(settings: GeometricSettings) -> tuple[GeometricLab, list[Message]]:
    """Render a lab with stationary markers, and detect them; return its ground truth and its messages.

    The log with all points stays in ``.cache/bench``. The result has the first ``settings.points`` of them.
    The settings of floor, clocks and wobble have no effect, and the intrinsics are the true ones.
    """
    rendered = LabSettings(seed=settings.lab.seed, stations=_STATIONS, drive_s=0.0)
    lab = build_lab(GeometricSettings(lab=rendered, points=1, intrinsics="true"))
    poses = [point.pose for points in plan_points(rendered, lab.cameras) for point in points]
    lab = replace(lab, points=tuple((pose,) for pose in poses[: settings.points]))
    return lab, list(_first_points(_detected(drawn(rendered)), settings.points))


def _detected(path: Path) -> Path:
    target = path.with_name(f"{path.stem}-detected.mcap")
    if not target.exists():
        replay([path], Request(), until="detect", output=target)
    return target


def _first_points(path: Path, count: int) -> Iterator[Message]:
    rest = path.with_name(f"{path.stem.removesuffix('-detected')}.mcap")
    with Session([rest, path]) as session:
        channels = (RIG, CALIBRATIONS, MEASUREMENTS)
        topics = {topic for channel in channels for topic in session.topics(channel)}
        seen = 0
        for message in session.messages(topics | set(session.topics(MARKERS, "edges"))):
            if not isinstance(message.payload, Measurement):
                yield message
            elif seen < count:
                seen += 1
                yield replace(message, payload=replace(message.payload, splits=("train",)))
