"""The dashboard of a hall with 24 cameras and nine robots: each part can be read on any screen."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.capture.live_check import FrameCheck
from ipsys_log.capture.simulation.settings import grid_names
from ipsys_log.messages import CameraModel, Model, RigMarker
from tests.web.contrast import low_contrasts
from tests.web.dashboards import RIG, LiveLab, event, frame, markers, page_of, robot, tracks
from tests.web.phone import Phone
from tests.web.test_dashboard_browser import COUNT, DESKTOP, PHONE, WALL, opened
from tests.web.test_dashboard_state import LENS, pairs_of_a_level_camera
from tests.web.test_measuring_page import says

# A browser.
pytestmark = pytest.mark.slow

NAMES = grid_names(6, 4)
BLURRED = FrameCheck((0,), (), 120.0, 1.0, ("the image is blurred: add light",))
ROWS = (
    "[...document.querySelectorAll('{} tbody tr')].map(row => [...row.children].map(cell => cell.innerText))"
)


def lab_of(folder: Path, names: tuple[str, ...]) -> LiveLab:
    """Return a recording of these cameras with nine robots; all cameras have one field of view."""
    model = Model(0, "poly", tuple(CameraModel(name, (), pairs=pairs_of_a_level_camera()) for name in names))
    lenses = {name: replace(LENS, frame_id=name) for name in names}
    rig = replace(RIG, markers=tuple(RigMarker(n, robot=f"robot_{n}") for n in range(9)))
    lab = LiveLab(folder / "monday.mcap", model, lenses, cameras=names, rig=rig)
    lab.checks.clear()
    for _ in range(2):  # the first image waits for later ones
        lab.run(1)
        for name in names:
            lab.feed(frame(lab.time_ns, name), markers(lab.time_ns, name))
    lab.feed(tracks(lab.time_ns, *(robot(n, 0.3 + n / 4, 1.0 + n / 8) for n in range(9))))
    return lab


@pytest.fixture
def hall(tmp_path: Path) -> LiveLab:
    """A hall whose camera d3 is lost, whose f4 has dropped frames, and of which two are blurred."""
    lab = lab_of(tmp_path, NAMES)
    lab.states["d3"].up, lab.states["f4"].dropped = False, 12
    lab.checks.update({"a2": BLURRED, "b1": BLURRED})
    lab.feed(event(lab.time_ns, "camera_lost", "camera d3 is lost", "d3"))
    return lab


def tops(browser: Phone, *selectors: str) -> Any:
    """Return the upper edges of parts of the page, in px."""
    return browser.run(f"{[*selectors]}.map(one => document.querySelector(one).getBoundingClientRect().top)")


@pytest.mark.parametrize("size", [PHONE, WALL], ids=["phone", "wall"])
def test_hall_fits_every_screen_in_both_schemes(browser: Phone, hall: LiveLab, size: tuple[int, int]) -> None:
    with page_of(hall.dashboard) as page, opened(browser, page.url, size):
        browser.wait(f"{COUNT.format('figure image')} === 24")
        says(browser, "#warnings", "blurred")
        assert browser.run("document.documentElement.scrollWidth") <= size[0]
        # No table hides a column.
        assert browser.run(
            "[...document.querySelectorAll('.wide')].every(one => one.scrollWidth <= one.clientWidth)"
        )
        # All images are on one screen, and their ids can be read.
        assert browser.run("document.querySelector('#tiles').offsetHeight < innerHeight")
        heights = browser.run(
            "[...document.querySelectorAll('figure text')].map(one => one.getBoundingClientRect().height)"
        )
        assert len(heights) == 24
        assert min(heights) >= 9
        events, images = tops(browser, "#events", "#tiles")
        assert events < images
        for scheme in ("light", "dark"):
            browser.prefer(scheme)
            assert low_contrasts(browser) == [], scheme


def test_cameras_with_faults_are_the_first_rows(browser: Phone, hall: LiveLab) -> None:
    with page_of(hall.dashboard) as page, opened(browser, page.url, DESKTOP):
        says(browser, "#cameras", "others")
        rows = browser.run(ROWS.format("#cameras"))
        assert [row[0] for row in rows] == ["d3", "f4", "a2", "b1", "20 others"]
        assert (rows[0][1], rows[1][2], rows[4][2]) == ("lost", "12", "0")
        assert browser.text("#warnings") == "a2, b1: the image is blurred: add light"
        browser.tap("#all-cameras summary")
        assert [row[0] for row in browser.run(ROWS.format("#all-cameras"))] == [*NAMES]


def test_map_outlines_only_the_selected_camera(browser: Phone, hall: LiveLab) -> None:
    with page_of(hall.dashboard) as page, opened(browser, page.url, DESKTOP):
        browser.wait(f"{COUNT.format('figure image')} === 24")
        assert browser.run(COUNT.format("#floor .camera")) == 24
        assert browser.run(COUNT.format("#floor .view")) == 0
        assert browser.run(COUNT.format("#legend li")) <= 6
        browser.tap("figure:nth-of-type(2)")
        assert browser.run("document.querySelector('#view').value") == "a2"
        assert browser.run(COUNT.format("#floor .view")) == 1
        assert browser.run("document.querySelector('#floor .camera.selected').textContent") == "a2"


def test_names_of_many_robots_leave_room_on_a_phone(browser: Phone, hall: LiveLab) -> None:
    names = "[...document.querySelectorAll('#floor .name')].map(one => one.textContent).join('')"
    for size, is_named in ((PHONE, False), (DESKTOP, True)):
        with page_of(hall.dashboard) as page, opened(browser, page.url, size):
            browser.wait(f"{COUNT.format('#floor .robot')} === 9")
            assert bool(browser.run(names)) == is_named
            says(browser, "#robots", "robot_8")
