"""The setup page of a hall with 24 cameras: short texts, compact cards, and faults first, on any screen."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ipsys_log.app.first_day.lab_folder import LabFolder
from ipsys_log.app.web.server import serve_app
from ipsys_log.app.web.setup import SetupApp
from ipsys_log.capture.simulation.settings import grid_names
from tests.web.contrast import low_contrasts
from tests.web.phone import Phone
from tests.web.test_dashboard_browser import COUNT, DESKTOP, PHONE, WALL
from tests.web.test_setup_browser import leave, unexpected

# A browser.
pytestmark = pytest.mark.slow

NAMES = grid_names(6, 4)
LAB = """name = "hall"
dictionary = "DICT_4X4_100"
marker_length_m = 0.2
"""
CAMERA = '[[cameras]]\nname = "{}"\nsource = "rtsp://192.168.1.{}/stream1"\n'
State = dict[str, Any]


def aligned(name: str, level: bool) -> State:
    """Return the alignment of a camera as the server sends it."""
    return {
        "camera": name, "level": level, "advice": "lower its left side", "size_px": [1280, 720],
        "centre_px": [640, 360], "plumb_px": [670, 340], "markers_px": [], "picture": None,
    }  # fmt: skip


def with_results(state: State) -> State:
    """Return the state of a lab whose a4 sends no image, and whose b1 is tilted."""
    next(one for one in state["cameras"] if one["name"] == "a4")["fault"] = "the camera sends no image"
    cameras = [aligned(name, name != "b1") for name in NAMES if name in str(state["cameras"])]
    state["alignment"] = {"cameras": cameras, "coverage": [["the floor is covered", True]], "notes": []}
    for step in state["steps"]:
        step["status"] = "ready"
    return state


@contextmanager
def serving(folder: Path, names: tuple[str, ...], change: Callable[[State], State]) -> Iterator[str]:
    cameras = "".join(CAMERA.format(name, 20 + n) for n, name in enumerate(names))
    (folder / "lab.toml").write_text(LAB + cameras, encoding="utf-8")
    setup = SetupApp(LabFolder(folder))
    describe = setup.session.describe
    setup.session.describe = lambda: change(describe())  # type: ignore[method-assign]
    with serve_app(setup.app, None, 0) as server:
        yield server.url
        setup.session.close()
        assert server.exceptions.count == 0, server.exceptions.first


@contextmanager
def opened(browser: Phone, url: str, step: str, size: tuple[int, int]) -> Iterator[None]:
    browser.open(f"{url}#{step}", size)
    browser.wait(f"document.querySelector('#step-{step}[aria-current]')")
    try:
        yield
    finally:
        leave(browser)
    assert unexpected(browser) == []


def box(browser: Phone, selector: str) -> list[float]:
    """Return the upper and lower edge of an element, and the height of the window, in px."""
    found = browser.run(
        f"(b => [b.top, b.bottom, innerHeight])(document.querySelector({selector!r}).getBoundingClientRect())"
    )
    return [float(value) for value in found]


@pytest.mark.parametrize("size", [PHONE, WALL], ids=["phone", "wall"])
def test_setup_of_a_hall_fits_every_screen(browser: Phone, tmp_path: Path, size: tuple[int, int]) -> None:
    with serving(tmp_path, NAMES, with_results) as url:
        for step in ("cameras", "intrinsics", "alignment"):
            with opened(browser, url, step, size):
                assert browser.run("document.documentElement.scrollWidth") <= size[0]
                _, bottom, high = box(browser, "#steps")
                assert bottom < high
                for scheme in ("light", "dark"):
                    browser.prefer(scheme)
                    assert low_contrasts(browser) == [], (step, scheme)


def test_save_and_faults_of_many_cameras_are_in_sight(browser: Phone, tmp_path: Path) -> None:
    with serving(tmp_path, NAMES, with_results) as url, opened(browser, url, "cameras", PHONE):
        top, bottom, high = box(browser, "#save")
        assert 0 <= top < bottom <= high
        assert "No picture of: a4." in browser.text("#panel")
        assert browser.text("#panel > .text") == "used: a1, a2, a3, a4, b1 and 19 more."
        # Each name field keeps its label for a screen reader.
        assert browser.run(
            "[...document.querySelectorAll('#panel input')].every(one => one.labels.length === 1)"
        )


def test_alignment_of_many_cameras_shows_those_to_turn(browser: Phone, tmp_path: Path) -> None:
    with serving(tmp_path, NAMES, with_results) as url, opened(browser, url, "alignment", DESKTOP):
        assert (
            browser.run("[...document.querySelectorAll('.card b')].filter(e => e.checkVisibility()).length")
            == 1
        )
        assert "Level cameras: 23" in browser.text("#panel")
        floor, _, _ = box(browser, ".lines .good")
        card, _, _ = box(browser, ".card")
        assert floor < card
        browser.tap("#panel details summary")
        assert browser.run(COUNT.format(".card")) == 24
        assert browser.run("document.querySelectorAll('.card')[23].checkVisibility()")
