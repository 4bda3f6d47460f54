"""Recording of a drive for ``ipsys calibrate-lab``: markers, measured points, and the expected error."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from ipsys_log.cli.console import progress_bar, remarks, say
from ipsys_log.cli.measure_live import live_scene, ready_to_measure, serve_live_page
from ipsys_log.cli.nominal_intrinsics import nominal_lenses
from ipsys_log.cli.open_cameras import check_target, open_cameras, prepare_lab

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ipsys_log.runs.options import Request
    from ipsys_log.sinks.sink import Consumer

_LEAST_POINTS = 2


def record_drive(
    output: Path,
    rig: Path,
    calibration: list[str] | None,
    nominal: Sequence[tuple[str, str]],
    corners: str | None,
    goal_m: float,
    seconds: float | None,
    page: tuple[str | None, int] | None,
    force: bool,
) -> None:
    """Record the cameras of a rig with their markers, until a signal; then ask for missing points.

    Parameters
    ----------
    output : the new log.
    rig, calibration : files of the rig and of intrinsics.
    nominal : options for nominal intrinsics, with their texts.
    corners : method of the corners.
    goal_m : wanted mean error of every camera.
    seconds : duration; None: until a signal.
    page : address and port of the measuring page; None: the terminal asks after the recording.
    force : overwrite an existing log.
    """
    from ipsys_log import pipeline
    from ipsys_log.extras import check_installed
    from ipsys_log.runs.options import Request
    from ipsys_log.survey.live_calibration import LiveCalibration

    if page is not None:
        check_installed("the measuring page needs", "starlette", "uvicorn")
    lab = prepare_lab(rig, None, calibration)
    sizes_px = {c.name: (c.width, c.height) for c in lab.cameras if c.width and c.height}
    lab.lenses.update(nominal_lenses(nominal, lab.names, lab.lenses, sizes_px))
    check_target(output, force, lab.files)
    request = Request(corners=corners)
    ready_to_measure(lab, request, None)
    if page is not None:
        from ipsys_log.web.server import check_port_free

        check_port_free(*page)
    with open_cameras(lab, output, seconds) as (cameras, settings, status):
        scene = live_scene(settings, cameras, None)
        calibrating = LiveCalibration(lab.rig, lab.lenses, goal_m, say)
        consumers: list[Consumer] = [status, scene, calibrating]
        try:
            with nullcontext() if page is None else serve_live_page(scene, *page):
                pipeline.live(cameras, settings, output, request, "camera-frame", consumers, force)
        finally:
            calibrating.close()
    if page is None or (len(scene.history()) < _LEAST_POINTS and sys.stdin.isatty()):
        _ask_points(output, request)


def _ask_points(output: Path, request: Request) -> None:
    """Ask for the points of the stationary intervals in the terminal."""
    from ipsys_log.cli.dialog import ask_places
    from ipsys_log.survey.from_log import open_finished_log

    with progress_bar() as progress, open_finished_log(output, request, progress, say) as scene:
        remarks.print(
            f"measure {_LEAST_POINTS} to 4 of the points at which a marker was stationary; s skips a point, "
            "q ends",
            markup=False,
        )
        ask_places(scene)
