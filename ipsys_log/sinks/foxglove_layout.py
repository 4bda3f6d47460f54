"""A layout of Foxglove for a log: images with markers, the floor from above, and plots.

The message paths of Foxglove cannot subtract. So small user scripts in the layout compute latencies and
errors from the messages of the log.
"""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import LATENCY_TOPIC, TRUTH_TOPIC, Rig
from ipsys_log.messages.channels import ANNOTATIONS, CALIBRATIONS, LATENCY, POSES, TRACKS
from ipsys_log.sinks.selection import Shown, choose_runs, rig_in_force

Panel = dict[str, Any]

# More lines in one plot cannot be told apart.
_MOST_ROBOTS = 8
_DIVISIONS = 10
# Images in one column, and columns of images per row of more images.
_MOST_ROWS, _TILES_ACROSS = 6, 0.7
_LATENCY = "/foxglove_script/latency"
_ERROR = "/foxglove_script/position_error"

_LATENCY_SCRIPT = """\
// The time from the arrival of a frame to its published position.
export const inputs = %(inputs)s;
export const output = %(output)s;
type Output = { camera: string; latency_ms: number };
export default function script(event: any): Output {
  const { camera, received, published } = event.message;
  const latency_ms = 1e3 * (published.sec - received.sec) + (published.nsec - received.nsec) / 1e6;
  return { camera, latency_ms };
}
"""
_ERROR_SCRIPT = """\
// The distance on the floor between a track and the ground truth of the same robot and instant.
export const inputs = %(inputs)s;
export const output = %(output)s;
type Output = { robots: { robot: string; error_mm: number }[] };
const waiting: any = {};
export default function script(event: any): Output | undefined {
  const { timestamp, tracks } = event.message;
  const robots = [];
  for (const track of tracks) {
    const key = `${track.robot} ${timestamp.sec} ${timestamp.nsec}`;
    const other = waiting[key];
    if (other === undefined || other.topic === event.topic) {
      waiting[key] = { topic: event.topic, x_m: track.x_m, y_m: track.y_m };
    } else {
      delete waiting[key];
      const error_mm = 1e3 * Math.hypot(track.x_m - other.x_m, track.y_m - other.y_m);
      robots.push({ robot: track.robot, error_mm });
    }
  }
  return robots.length > 0 ? { robots } : undefined;
}
"""


def make_layout(session: Session, runs: Sequence[str] = ()) -> dict[str, Any]:
    """Return the layout of a log as plain data for JSON; of several runs, the first one is shown."""
    shown = choose_runs(session, runs)
    rig = rig_in_force(session, [run for run in (shown.markers, *shown.runs) if run])
    images = {f"Image!{camera}": _image(session, shown, camera) for camera in sorted(session.images)}
    floor = {"3D!floor": _floor(session, shown.runs, rig)}
    plots, scripts = _plots(session, shown.runs[:1], _robots(rig), sorted(session.images))
    right = _split("column", ["3D!floor", *plots], first_share=60)
    return {
        "configById": {**images, **floor, **plots},
        "globalVariables": {},
        "userNodes": scripts,
        "playbackConfig": {"speed": 1},
        "layout": _join("row", _grid(list(images)), right, 40) if images else right,
    }


def _image(session: Session, shown: Shown, camera: str) -> Panel:
    mode: Panel = {"imageTopic": session.images[camera]}
    calibrations = [topic for topic in session.topics(CALIBRATIONS) if camera_of_topic(topic) == camera]
    if calibrations:
        mode["calibrationTopic"] = calibrations[0]
    drawn = session.topics(ANNOTATIONS, shown.markers) if shown.markers else []
    mode["annotations"] = {topic: {"visible": True} for topic in drawn if camera_of_topic(topic) == camera}
    return {"imageMode": mode, "foxglovePanelTitle": camera}


def _floor(session: Session, runs: Sequence[str], rig: Rig | None) -> Panel:
    topics = [topic for run in runs for topic in session.topics(POSES, run)]
    panel: Panel = {
        "followTf": "world",
        "followMode": "follow-none",
        "scene": {"transforms": {"showLabel": True}},
        "topics": {topic: {"visible": True} for topic in topics},
        "foxglovePanelTitle": "Floor",
    }
    if rig is not None and rig.floor is not None:
        middle, size_m = (
            [rig.floor.width_m / 2, rig.floor.depth_m / 2],
            max(rig.floor.width_m, rig.floor.depth_m),
        )
        grid = {"layerId": "foxglove.Grid", "visible": True, "frameId": "world", "size": size_m}
        panel["layers"] = {"grid": {**grid, "divisions": _DIVISIONS, "position": [*middle, 0]}}
        # Straight down, with y upward, as on the plan of the tape measurements.
        view = {"perspective": False, "distance": 1.15 * size_m, "phi": 0, "thetaOffset": 0}
        panel["cameraState"] = {**view, "targetOffset": [*middle, 0]}
    return panel


def _robots(rig: Rig | None) -> dict[str, str]:
    """Return the axes to plot by robot: z only of robots that are not level."""
    if rig is None:
        return {}
    names = list(dict.fromkeys(marker.robot or f"marker_{marker.id}" for marker in rig.markers))
    free = {body.robot for body in rig.bodies if not body.level}
    return {name: "xyz" if name in free else "xy" for name in names[:_MOST_ROBOTS]}


def _plots(
    session: Session, runs: Sequence[str], robots: Mapping[str, str], cameras: Sequence[str]
) -> tuple[dict[str, Panel], dict[str, Any]]:
    """Return the plots that the log has data for, and the user scripts that they need."""
    plots, scripts = {}, {}
    tracks = [topic for run in runs for topic in session.topics(TRACKS, run)]
    if tracks:
        plots["Plot!position"] = _plot(
            "Position, m",
            {
                f"{robot} {axis}": f'{tracks[0]}.tracks[:]{{robot=="{robot}"}}.{axis}_m'
                for robot, axes in robots.items()
                for axis in axes
            },
        )
    if tracks and session.count(TRUTH_TOPIC):
        scripts["position_error"] = _script("position_error", _ERROR_SCRIPT, [TRUTH_TOPIC, tracks[0]], _ERROR)
        paths = {robot: f'{_ERROR}.robots[:]{{robot=="{robot}"}}.error_mm' for robot in robots}
        plots["Plot!error"] = _plot("Position error, mm", paths)
    if session.topics(LATENCY):
        scripts["latency"] = _script("latency", _LATENCY_SCRIPT, [LATENCY_TOPIC], _LATENCY)
        shown = cameras if len(cameras) <= _MOST_ROBOTS else ()
        paths = {camera: f'{_LATENCY}{{camera=="{camera}"}}.latency_ms' for camera in shown}
        # The lines of more cameras cannot be told apart: one line has all of them.
        paths = paths or {"all cameras": f"{_LATENCY}.latency_ms"}
        plots["Plot!latency"] = _plot("Latency, ms", paths)
    return plots, scripts


def _script(name: str, source: str, inputs: Sequence[str], output: str) -> dict[str, str]:
    topics = {"inputs": json.dumps(inputs), "output": json.dumps(output)}
    return {"name": f"ipsys/{name}", "sourceCode": source % topics}


def _plot(title: str, values: Mapping[str, str]) -> Panel:
    """Return a plot of message paths, by their names in the legend."""
    paths = [
        {"value": value, "label": label, "enabled": True, "timestampMethod": "receiveTime"}
        for label, value in values.items()
    ]
    return {
        "paths": paths,
        "showLegend": True,
        "legendDisplay": "floating",
        "isSynced": True,
        "xAxisVal": "timestamp",
        "foxglovePanelTitle": title,
    }


def _split(direction: str, ids: Sequence[Any], first_share: float | None = None) -> Any:
    """Return panels one after the other; the first one has its share in per cent, the others equal parts."""
    if len(ids) == 1:
        return ids[0]
    return _join(direction, ids[0], _split(direction, ids[1:]), first_share or 100 / len(ids))


def _grid(ids: Sequence[str]) -> Any:
    """Return panels as rows of one column, or of a few columns for many panels."""
    columns = 1 if len(ids) <= _MOST_ROWS else max(2, math.floor(math.sqrt(len(ids) * _TILES_ACROSS)))
    rows = [_split("row", ids[first : first + columns]) for first in range(0, len(ids), columns)]
    return _split("column", rows)


def _join(direction: str, first: Any, second: Any, share: float) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": share}
