"""The results of a robot run as tables for a terminal, as JSON, and as an HTML page."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from ipsys_log.analysis.robot_run import RobotResult, RobotRunResult, Stop, read_robot_run
from ipsys_log.log.dataset import Session
from ipsys_log.messages import ErrorStatistics
from ipsys_log.units import CM_PER_M, NS_PER_S

# The panels hold photographs: more pixels would only make the page larger.
_PANELS_DPI = 110


def robot_run_tables(result: RobotRunResult) -> Group:
    """Return the errors of each robot at its waypoints and over its drive, in cm."""
    parts: list[Table | Text] = []
    for robot in result.robots:
        parts.append(Text(f"{robot.name}: errors in cm at the waypoints; true: median, 95 %, max", "bold"))
        parts += [_waypoint_table(robot, result.start_ns), Text("Positions over the drive, errors in cm")]
        parts.append(_drive_table(robot))
        parts += [Text(stop_line(robot.name, stop, result.start_ns)) for stop in robot.stops]
        if not robot.is_finished:
            text = f"{robot.name} reached {len(robot.reached)} of {len(robot.path)} waypoints"
            parts.append(Text(text, style="red"))
    if result.nearest_m is not None:
        parts.append(Text(f"smallest distance between two robots: {result.nearest_m:.2f} m"))
    return Group(*parts)


def _waypoint_table(robot: RobotResult, start_ns: int) -> Table:
    table = Table(box=None, pad_edge=False)
    models = list(robot.positioning_m)
    for heading in ("waypoint", "time", "control", "true", *models):
        table.add_column(heading, justify="left" if heading == "waypoint" else "right")
    for row in _rows(robot, start_ns, models):
        table.add_row(*row)
    return table


def _rows(robot: RobotResult, start_ns: int, models: Iterable[str]) -> list[list[str]]:
    """Return the cells of the table of waypoints."""
    rows = []
    for point in robot.reached:
        time_s = (point.start_ns - start_ns) / NS_PER_S
        cells = [f"P{point.number} ({point.place.x_m:g}, {point.place.y_m:g})", f"{time_s:.1f} s"]
        cells += [_cm(point.control_m), _three(point.true_m)]
        cells += [_cm(e.median_m) if (e := point.positioning_m.get(run)) else "-" for run in models]
        rows.append(cells)
    return rows


def _drive_table(robot: RobotResult) -> Table:
    table = Table(box=None, pad_edge=False)
    for heading in ("run", "median", "95 %", "max", "instants"):
        table.add_column(heading, justify="left" if heading == "run" else "right")
    for run, errors in robot.positioning_m.items():
        table.add_row(run, *map(_cm, (errors.median_m, errors.p95_m, errors.max_m)), str(errors.count))
    return table


def stop_line(robot: str, stop: Stop, start_ns: int) -> str:
    """Return a line about a robot without positions."""
    begin_s, end_s = ((time_ns - start_ns) / NS_PER_S for time_ns in (stop.start_ns, stop.end_ns))
    text = f"{robot}: stopped from {begin_s:.1f} to {end_s:.1f} s"
    if stop.age_s is not None:
        text += f", {stop.age_s:.2f} s after its last position"
    if stop.braking_m is None or stop.moved_m is None:
        return text
    braking_cm, moved_cm = CM_PER_M * stop.braking_m, CM_PER_M * stop.moved_m
    return f"{text}; it moved {braking_cm:.1f} cm since then, {moved_cm:.1f} cm after its stop"


def _three(errors: ErrorStatistics | None) -> str:
    return "-" if errors is None else " ".join(map(_cm, (errors.median_m, errors.p95_m, errors.max_m)))


def _cm(value_m: float | None) -> str:
    return "-" if value_m is None else f"{CM_PER_M * value_m:.2f}"


def robot_run_json(result: RobotRunResult) -> dict[str, Any]:
    """Return the results as plain data; lengths are in m."""
    return {
        "seconds": (result.end_ns - result.start_ns) / NS_PER_S,
        "nearest_m": result.nearest_m,
        "robots": [_robot_json(robot, result.start_ns) for robot in result.robots],
    }


def _robot_json(robot: RobotResult, start_ns: int) -> dict[str, Any]:
    return {
        "robot": robot.name,
        "finished": robot.is_finished,
        "waypoints": [
            {
                "number": point.number,
                "x_m": point.place.x_m,
                "y_m": point.place.y_m,
                "arrival_s": (point.start_ns - start_ns) / NS_PER_S,
                "control_m": point.control_m,
                "true": None if point.true_m is None else _errors_json(point.true_m),
                "positioning": {run: _errors_json(errors) for run, errors in point.positioning_m.items()},
            }
            for point in robot.reached
        ],
        "positioning": {run: _errors_json(errors) for run, errors in robot.positioning_m.items()},
        "stops": [
            {
                "start_s": (stop.start_ns - start_ns) / NS_PER_S,
                "end_s": (stop.end_ns - start_ns) / NS_PER_S,
                "age_s": stop.age_s,
                "braking_m": stop.braking_m,
                "moved_m": stop.moved_m,
            }
            for stop in robot.stops
        ],
    }


def _errors_json(errors: ErrorStatistics) -> dict[str, float | int | None]:
    known = asdict(errors)
    return {name: known[name] for name in ("count", "median_m", "p95_m", "max_m")}


def render_robot_run(session: Session) -> tuple[str, bytes]:
    """Return the HTML page of a robot run, and the PNG of its figure (figure 12 of the paper).

    Raises
    ------
    IpsysError
        The log has no robot run.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    from ipsys_log.report.figures import png, svg_data_uri
    from ipsys_log.report.robot_run_figure import draw_drive, draw_panels, draw_paths

    result = read_robot_run(session)
    panels = [png(draw_panels(session, result, robot), _PANELS_DPI) for robot in result.robots]
    environment = Environment(
        loader=PackageLoader("ipsys_log", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    robots = [
        {
            **_robot_values(robot, result.start_ns),
            "panels": f"data:image/png;base64,{base64.b64encode(image).decode()}",
            "map": svg_data_uri(draw_drive(session, robot)),
        }
        for robot, image in zip(result.robots, panels, strict=True)
    ]
    text = environment.get_template("robot_run.html").render(
        log=session.paths[-1].name,
        seconds=f"{(result.end_ns - result.start_ns) / NS_PER_S:.1f}",
        nearest=None if result.nearest_m is None else f"{result.nearest_m:.2f}",
        paths=svg_data_uri(draw_paths(session, result)) if len(robots) > 1 else None,
        robots=robots,
    )
    return text, panels[0]


def _robot_values(robot: RobotResult, start_ns: int) -> dict[str, Any]:
    """Return the texts of a robot on the page."""
    return {
        "name": robot.name,
        "models": list(robot.positioning_m),
        "rows": _rows(robot, start_ns, robot.positioning_m),
        "drive": [(run, _three(errors)) for run, errors in robot.positioning_m.items()],
        "stops": [stop_line(robot.name, stop, start_ns) for stop in robot.stops],
        "reached": f"{len(robot.reached)} of {len(robot.path)}",
    }
