"""The results of a robot run as tables for a terminal, as JSON, and as an HTML page."""

import base64
from typing import Any

from rich.console import Group
from rich.text import Text

from ipsys_log.app.report.json_format import plain
from ipsys_log.app.report.rows import Rows, cm
from ipsys_log.log.dataset import Session
from ipsys_log.messages import ErrorStatistics
from ipsys_log.tools.robot_run import RobotResult, RobotRunResult, Stop, read_robot_run
from ipsys_log.units import NS_PER_S

# The panels hold photographs: more pixels would only make the page larger.
_PANELS_DPI = 110


def robot_run_tables(result: RobotRunResult) -> Group:
    """Return the errors of each robot at its waypoints and over its drive, in cm."""
    parts: list[Rows | Text] = []
    for robot in result.robots:
        parts += [_waypoints(robot, result.start_ns), _drive(robot)]
        parts += [Text(stop_line(robot.name, stop, result.start_ns)) for stop in robot.stops]
        if not robot.is_finished:
            text = f"{robot.name} reached {len(robot.reached)} of {len(robot.path)} waypoints"
            parts.append(Text(text, style="red"))
    if result.nearest_m is not None:
        parts.append(Text(f"smallest distance between two robots: {result.nearest_m:.2f} m"))
    return Group(*parts)


def _waypoints(robot: RobotResult, start_ns: int) -> Rows:
    """Return a row for each reached waypoint; a run has its median error there."""
    cells = []
    for point in robot.reached:
        time_s = (point.start_ns - start_ns) / NS_PER_S
        place = f"P{point.number} ({point.place.x_m:g}, {point.place.y_m:g})"
        row = [place, f"{time_s:.1f} s", cm(point.control_m)]
        row.append("-" if point.true_m is None else " ".join(_three(point.true_m)))
        row += [cm(e.median_m) if (e := point.positioning_m.get(run)) else "-" for run in robot.positioning_m]
        cells.append(row)
    columns = ("waypoint", ">time", ">control", ">true", *(f">{run}" for run in robot.positioning_m))
    return Rows(f"{robot.name}: errors in cm at the waypoints; true: median, 95 %, max", columns, cells)


def _drive(robot: RobotResult) -> Rows:
    cells = [[run, *_three(errors), str(errors.count)] for run, errors in robot.positioning_m.items()]
    columns = ("run", ">median", ">95 %", ">max", ">instants")
    return Rows("Positions over the drive, errors in cm", columns, cells)


def _three(errors: ErrorStatistics) -> list[str]:
    return [cm(errors.median_m), cm(errors.p95_m), cm(errors.max_m)]


def stop_line(robot: str, stop: Stop, start_ns: int) -> str:
    """Return a line about a robot without positions."""
    begin_s, end_s = ((time_ns - start_ns) / NS_PER_S for time_ns in (stop.start_ns, stop.end_ns))
    text = f"{robot}: stopped from {begin_s:.1f} to {end_s:.1f} s"
    if stop.age_s is not None:
        text += f", {stop.age_s:.2f} s after its last position"
    if stop.braking_m is None or stop.moved_m is None:
        return text
    moved, after = cm(stop.braking_m, 1), cm(stop.moved_m, 1)
    return f"{text}; it moved {moved} cm since then, {after} cm after its stop"


def robot_run_json(result: RobotRunResult) -> dict[str, Any]:
    """Return the results as plain data; lengths are in m."""
    return {
        "duration_s": (result.end_ns - result.start_ns) / NS_PER_S,
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
                "true": plain(point.true_m),
                "positioning": plain(point.positioning_m),
            }
            for point in robot.reached
        ],
        "positioning": plain(robot.positioning_m),
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


def render_robot_run(session: Session) -> tuple[str, bytes]:
    """Return the HTML page of a robot run, and the PNG of its figure (figure 12 of the paper)."""
    from ipsys_log.app.report.drive_figures import draw_drive, draw_panels, draw_paths
    from ipsys_log.app.report.figures import png, svg_data_uri
    from ipsys_log.app.report.html import render_page

    result = read_robot_run(session)
    panels = [png(draw_panels(session, result, robot), _PANELS_DPI) for robot in result.robots]
    robots = [
        {
            **_robot_values(robot, result.start_ns),
            "panels": f"data:image/png;base64,{base64.b64encode(image).decode()}",
            "map": svg_data_uri(draw_drive(session, robot)),
        }
        for robot, image in zip(result.robots, panels, strict=True)
    ]
    text = render_page(
        "robot_run.html",
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
        "waypoints": _waypoints(robot, start_ns),
        "drive": _drive(robot),
        "stops": [stop_line(robot.name, stop, start_ns) for stop in robot.stops],
        "reached": f"{len(robot.reached)} of {len(robot.path)}",
    }
