"""Sections of the HTML page on the recording itself: cameras, gaps, events and latency."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ipsys_log.analysis.latency import Percentiles, latency_percentiles, step_times_s
from ipsys_log.analysis.recording import CameraRecording, EventGroup, group_events, read_cameras
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import LATENCY
from ipsys_log.report.figures import style_axes
from ipsys_log.report.html_figures import new_figure, picture
from ipsys_log.report.latency_figure import draw_shares, draw_steps
from ipsys_log.report.styles import camera_styles, shorten
from ipsys_log.units import NS_PER_S, format_bytes, format_duration

# Number of gaps in the table; the figure shows all of them.
_MOST_GAPS = 8
_MS_PER_S = 1e3


def recording_values(session: Session) -> dict[str, Any]:
    """Return the values of the templates on the recording of a session."""
    cameras, events = read_cameras(session), group_events(session)
    start_ns = session.start_ns
    return {
        "duration": format_duration((session.end_ns - start_ns) / NS_PER_S),
        "sizes": [(reader.path.name, format_bytes(reader.size)) for reader in session.readers],
        "cameras": [_camera_row(session, camera) for camera in cameras],
        "gaps": _gap_rows(cameras, start_ns),
        "gap_count": sum(len(camera.gaps.lengths_s) for camera in cameras),
        "events": [_event_row(group, start_ns) for group in events],
        "timeline_pictures": _timeline(session, cameras, events),
        **_latency(session),
    }


def _camera_row(session: Session, recorded: CameraRecording) -> dict[str, str]:
    lens = _size(session, recorded.camera)
    rate_hz = recorded.gaps.rate_hz
    missing_s = sum(recorded.gaps.lengths_s)
    return {
        "camera": recorded.camera,
        "frames": str(recorded.frames),
        "rate": "–" if rate_hz is None else f"{rate_hz:.1f}",
        "lens": lens,
        "gaps": str(len(recorded.gaps.lengths_s)),
        "missing": f"{missing_s:.1f}" if missing_s else "0",
    }


def _size(session: Session, camera: str) -> str:
    if camera not in session.calibrations:
        return "missing"
    lens = session.payloads([session.calibrations[camera]])[-1]
    return f"{lens.width} x {lens.height} px, {lens.distortion_model}"


def _gap_rows(cameras: Sequence[CameraRecording], start_ns: int) -> list[dict[str, str]]:
    """Return the longest gaps of all cameras."""
    gaps = [
        (length_s, camera.camera, (begin_ns - start_ns) / NS_PER_S)
        for camera in cameras
        for begin_ns, length_s in zip(camera.gaps.starts_ns, camera.gaps.lengths_s, strict=True)
    ]
    return [
        {"camera": camera, "start": f"{begin_s:.1f}", "length": f"{length_s:.2f}"}
        for length_s, camera, begin_s in sorted(gaps, key=lambda gap: (-gap[0], gap[2]))[:_MOST_GAPS]
    ]


def _event_row(group: EventGroup, start_ns: int) -> dict[str, str]:
    first_s, last_s = ((time_ns - start_ns) / NS_PER_S for time_ns in (group.times_ns[0], group.times_ns[-1]))
    return {
        "kind": group.kind,
        "camera": group.camera or "–",
        "run": group.run or "–",
        "count": str(len(group.times_ns)),
        "first": f"{first_s:.1f}",
        "last": f"{last_s:.1f}",
        "text": group.text,
    }


def _timeline(
    session: Session, cameras: Sequence[CameraRecording], events: Sequence[EventGroup]
) -> list[dict[str, Any]]:
    """Return the figure of the recorded times of the cameras, with their gaps and events."""
    if not cameras:
        return []
    figure, axes = new_figure(1.1 + 0.34 * (len(cameras) + 1))
    styles = camera_styles([camera.camera for camera in cameras])
    for row, camera in enumerate(cameras):
        _draw_recorded(axes, row, camera, session.start_ns, styles[camera.camera][0])
    marks = [(time_ns, group.camera) for group in events if group.run is None for time_ns in group.times_ns]
    rows = {camera.camera: row for row, camera in enumerate(cameras)}
    if marks:
        times_s = [(time_ns - session.start_ns) / NS_PER_S for time_ns, _ in marks]
        places = [rows.get(camera or "", len(cameras)) for _, camera in marks]
        axes.plot(times_s, places, "|", color="black", ms=11, mew=1.2)
    names = [shorten(camera.camera) for camera in cameras]
    axes.set_yticks(range(len(cameras) + 1), [*names, "all"])
    axes.set_ylim(len(cameras) + 0.6, -0.6)
    axes.set_xlim(0, max((session.end_ns - session.start_ns) / NS_PER_S, 1e-3))
    axes.set_xlabel("time in s")
    style_axes(axes, "x")
    caption = "Recorded frames of each camera. White: gaps. Black lines: events of the recording"
    return [picture(figure, caption)]


def _draw_recorded(axes: Axes, row: int, camera: CameraRecording, start_ns: int, colour: str) -> None:
    gaps = zip(camera.gaps.starts_ns, camera.gaps.lengths_s, strict=True)
    begins_ns = [camera.start_ns, *(gap_ns + round(length_s * NS_PER_S) for gap_ns, length_s in gaps)]
    ends_ns = [*camera.gaps.starts_ns, camera.end_ns]
    bars_s = [
        ((begin_ns - start_ns) / NS_PER_S, (end_ns - begin_ns) / NS_PER_S)
        for begin_ns, end_ns in zip(begins_ns, ends_ns, strict=True)
    ]
    # The edge keeps a single frame visible, whose bar has no width.
    axes.broken_barh(bars_s, (row - 0.25, 0.5), fc=colour, ec=colour, lw=1.0)


def _latency(session: Session) -> dict[str, Any]:
    """Return the table and the figures of the latency; empty for a session without live positions."""
    entries = session.payloads(session.topics(LATENCY))
    times_s = step_times_s(entries) if entries else {}
    if not entries:
        return {"latency": [], "latency_count": 0, "latency_pictures": []}
    shares, axes = new_figure(3.4)
    draw_shares(axes, np.sort(times_s["total"]) * _MS_PER_S, is_narrow=True)
    steps, step_axes = new_figure(3.4)
    draw_steps(step_axes, times_s)
    return {
        "latency": [_latency_row(step, one) for step, one in latency_percentiles(times_s).items()],
        "latency_count": len(entries),
        "latency_pictures": [
            picture(shares, "Share of the positions within a latency, from the arrival of a frame"),
            picture(steps, "Duration of each step: median and 99th percentile"),
        ],
    }


def _latency_row(step: str, found: Percentiles) -> tuple[str, list[str]]:
    values_s = (found.median_s, found.p90_s, found.p99_s, found.max_s)
    return step, [f"{value_s * _MS_PER_S:.1f}" for value_s in values_s]
