"""Figures of a hall with 24 cameras: no tangle of lines, no long row, and the worst cameras first."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from jinja2 import ChoiceLoader, DictLoader, Environment, PackageLoader
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from ipsys_log.app.report.calibration_figures import clocks_figure, poses_figure
from ipsys_log.app.report.findings import Findings
from ipsys_log.app.report.html_figures import joint_pictures, other_residual_pictures
from ipsys_log.app.report.points_figures import draw_hulls
from ipsys_log.capture.simulation.settings import grid_names
from ipsys_log.messages import Floor
from ipsys_log.sinks.video.composite import _arrange
from ipsys_log.statistics.calibrated_cameras import CalibratedCamera
from tests import labs
from tests.report.test_joint_figures import calibrated

NAMES = grid_names(6, 4)
RIG = replace(labs.RIG, floor=Floor(20.0, 15.0))


def hall() -> tuple[CalibratedCamera, ...]:
    """Return 24 cameras; d2 has the largest residuals."""
    cameras = []
    for n, name in enumerate(NAMES):
        camera = calibrated(name, 2.0 + 3 * (n % 4), 0.0001)
        assert camera.residuals is not None
        rms_px = 0.09 if name == "d2" else 0.02 + n / 1e4
        cameras.append(replace(camera, residuals=replace(camera.residuals, total_rms_px=rms_px)))
    return tuple(cameras)


def drawn_lines(figure: Figure) -> int:
    """Return the number of lines and outlines that a reader must tell apart on the first map."""
    axes = figure.axes[0]
    outlines = [
        patch for patch in axes.patches if to_rgba(patch.get_edgecolor())[3] and patch.get_linewidth()
    ]
    return len(outlines) + sum(line.get_linestyle() != "None" for line in axes.lines)


def test_poses_of_a_hall_have_names_and_values_but_no_outlines() -> None:
    figure = poses_figure(hall(), RIG)
    above, heights, sigmas = figure.axes
    assert {text.get_text() for text in above.texts} >= {*NAMES}
    assert drawn_lines(figure) <= 2
    assert not figure.legends
    # The map shows the floor, not the far ends of the views.
    assert above.get_xlim()[1] - above.get_xlim()[0] < 25
    for axes in (heights, sigmas):
        assert [label.get_text() for label in axes.get_xticklabels()] == [*NAMES]
    assert np.allclose(sigmas.lines[0].get_ydata(), np.sqrt(2.0))


@pytest.mark.slow
def test_page_of_a_hall_shows_the_largest_residuals_first() -> None:
    cameras = hall()[8:16]
    findings = Findings(RIG, (), {}, NAMES, None, cameras)
    images = [one["caption"] for one in joint_pictures(findings) if "residuals" in one["caption"]]
    assert 1 <= len(images) <= 6
    assert "image of d2," in images[0]
    rest = [one["caption"] for one in other_residual_pictures(findings)]
    assert len(images) + len(rest) == len(cameras)
    few = replace(findings, calibrated=hall()[:3])
    assert len([one for one in joint_pictures(few) if "residuals" in one["caption"]]) == 3
    assert other_residual_pictures(few) == []


def test_clock_labels_of_a_hall_do_not_overlap() -> None:
    figure = clocks_figure(hall())
    figure.canvas.draw()
    boxes = [label.get_window_extent() for label in figure.axes[0].get_yticklabels()]
    assert len(boxes) == 24
    assert all(above.y0 >= below.y1 for above, below in pairwise(boxes))


def test_hulls_of_many_cameras_are_grey() -> None:
    class Fitted:
        cameras = NAMES

        def training_m(self) -> dict[str, Any]:
            rng = np.random.default_rng(0)
            return {name: rng.uniform(0, 5, (6, 3)) for name in self.cameras}

    findings: Any = Fitted()
    axes = Figure().add_subplot()
    draw_hulls(axes, findings)
    assert len({patch.get_edgecolor() for patch in axes.patches}) == 1
    assert [text.get_text() for text in axes.texts] == [*NAMES]
    findings.cameras = NAMES[:3]
    axes = Figure().add_subplot()
    draw_hulls(axes, findings)
    assert len({patch.get_edgecolor() for patch in axes.patches}) == 3
    assert len(axes.get_legend_handles_labels()[1]) == 3


def test_tables_of_many_cameras_are_folded_on_the_page() -> None:
    page = (
        '{% from "session_macros.html" import each_camera %}{% call each_camera(n, n > 6) %}rows{% endcall %}'
    )
    loader = ChoiceLoader([DictLoader({"page": page}), PackageLoader("ipsys_log", "app/report")])
    template = Environment(loader=loader, autoescape=True).get_template("page")
    assert "Each of the 24 cameras" in template.render(n=24)
    assert "details" not in template.render(n=3)


@pytest.mark.parametrize(("count", "columns"), [(3, 1), (8, 2), (9, 3), (24, 4)])
def test_video_of_many_cameras_has_the_largest_pictures(count: int, columns: int) -> None:
    left, places = _arrange(count, (1920, 1080))
    assert len({x for x, *_ in places}) == columns
    assert left <= 960
