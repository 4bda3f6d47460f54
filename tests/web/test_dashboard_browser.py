"""The dashboard in a browser: its content, its keyboard, its sizes and its colours."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ipsys_log.messages import CameraModel, Model
from ipsys_log.units import NS_PER_S
from tests.web.contrast import low_contrasts
from tests.web.dashboards import (
    BEGIN_NS,
    TILTED,
    LiveLab,
    event,
    frame,
    latency,
    markers,
    page_of,
    robot,
    tracks,
)
from tests.web.phone import Phone
from tests.web.test_dashboard_state import LENS, Stream, pairs_of_a_level_camera
from tests.web.test_measuring_page import FETCHED, says

# A browser.
pytestmark = pytest.mark.slow

PHONE, DESKTOP, WALL = (390, 844), (1280, 900), (2560, 1440)
COUNT = "document.querySelectorAll({!r}).length"


@contextmanager
def opened(browser: Phone, url: str, size: tuple[int, int]) -> Iterator[None]:
    """Open a page, and leave it at the end; the browser must have reported no error."""
    browser.open(url, size)
    try:
        yield
    finally:  # a test that fails leaves nothing for the next one
        browser.send("Page.navigate", url="about:blank")
        browser.wait("location.href === 'about:blank'")
        errors, browser.console[:] = list(browser.console), []
    assert errors == []


@pytest.fixture
def lab(tmp_path: Path) -> LiveLab:
    model = Model(0, "poly", (CameraModel("red", (), pairs=pairs_of_a_level_camera()),))
    lab = LiveLab(tmp_path / "monday.mcap", model, {"red": LENS}, [Stream()])
    (tmp_path / "monday.mcap").write_bytes(b"x" * 1000)
    for n in range(60):
        time_ns = BEGIN_NS + n * 100_000_000
        lab.time_ns = time_ns
        lab.feed(tracks(time_ns, robot(0, 1 + n / 50, 1.0), robot(9, 0.5, 2.5)), latency(time_ns))
        for camera in ("red", "white"):
            lab.feed(frame(time_ns, camera), markers(time_ns, camera))
    lab.feed(event(lab.time_ns, "camera_lost", "camera white is lost; " + "x" * 80, "white"))
    return lab


def press(browser: Phone, key: str, text: str = "") -> None:
    code = {"Tab": 9, "Enter": 13}[key]
    given = {"key": key, "code": key, "windowsVirtualKeyCode": code}
    browser.send("Input.dispatchKeyEvent", type="keyDown", **given, **({"text": text} if text else {}))
    browser.send("Input.dispatchKeyEvent", type="keyUp", **given)


def focus(browser: Phone, selector: str) -> None:
    """Move the focus with the tabulator key only."""
    for _ in range(20):
        if browser.run(f"document.activeElement?.matches({selector!r}) ?? false"):
            return
        press(browser, "Tab")
    raise AssertionError(f"the tabulator key does not reach {selector}")


def test_page_shows_robots_images_and_states(browser: Phone, lab: LiveLab) -> None:
    with page_of(lab.dashboard) as page, opened(browser, page.url, DESKTOP):
        says(browser, "#state", "live")
        browser.wait(f"{COUNT.format('figure image')} === 2")
        browser.wait(f"{COUNT.format('figure polygon')} === 2")
        browser.wait(f"{COUNT.format('#floor .robot')} === 1")
        browser.wait(f"{COUNT.format('#floor .other')} === 1")
        browser.wait(f"{COUNT.format('#floor .view')} === 1")
        # The trail has the points from before the page was opened, and the map is true to scale.
        browser.wait("document.querySelector('.trail').points.length >= 50")
        width, height = browser.run(
            "(b => [b.width, b.height])(document.querySelector('#floor .ground').getBoundingClientRect())"
        )
        assert width / height == pytest.approx(4 / 3, rel=0.02)
        robot_at, ground = browser.run(
            "['#floor .robot circle', '#floor .ground'].map(one => document.querySelector(one))"
            ".map(one => one.getBoundingClientRect()).map(b => [b.x, b.y, b.width, b.height])"
        )
        x_m = (robot_at[0] + robot_at[2] / 2 - ground[0]) / ground[2] * 4
        y_m = 3 - (robot_at[1] + robot_at[3] / 2 - ground[1]) / ground[3] * 3
        assert (x_m, y_m) == pytest.approx((1 + 59 / 50, 1.0), abs=0.03)
        for selector, text in {
            "#robots": "0 robot_0",
            "#cameras": "4 ms",
            "#warnings": "red: the image is blurred",
            "#recording": "monday.mcap",
            "#events": "camera white is lost",
            "#latency": "14.0 ms",
            "#streams": "VRPN port 3883",
            "#overlap": "No robot is in the view of two cameras",
        }.items():
            says(browser, selector, text)
        browser.wait("document.querySelector('#events .error b').innerText === 'error'")
        lab.run(0.1)
        lab.feed(tracks(lab.time_ns, robot(1, 3.0, 2.0)))
        browser.wait(f"{COUNT.format('#floor .robot')} === 2")
        assert browser.run(f"{FETCHED}.every(name => name.startsWith(location.origin))")
        lab.end()
        says(browser, "#state", "recording ended")
        says(browser, "#operation", "The recording has ended")


def test_operator_needs_only_the_keyboard(browser: Phone, lab: LiveLab) -> None:
    with page_of(lab.dashboard) as page, opened(browser, page.url, DESKTOP):
        says(browser, "#operation", "No device operates")
        focus(browser, "#take")
        press(browser, "Enter", "\r")
        says(browser, "#operation", "This device operates")
        focus(browser, "#mark")
        browser.send("Input.insertText", text="robot pushed")
        press(browser, "Enter", "\r")
        says(browser, "#events", "robot pushed")
        focus(browser, "#segment")
        browser.send("Input.insertText", text="warm-up")
        press(browser, "Enter", "\r")
        says(browser, "#segment-save", "Stop warm-up")
        says(browser, "#recording", "warm-up, 0:00:00")
        focus(browser, "#segment-save")
        press(browser, "Enter", "\r")
        says(browser, "#events", "segment warm-up ended")
        assert [written.kind for written in lab.written] == ["mark", "segment_started", "segment_ended"]
        # After a reload it is the same device; another one may take over.
        browser.reload()
        says(browser, "#operation", "This device operates")
        lab.operator.seat.claim(True)
        says(browser, "#operation", "Another device operates")
        browser.wait("!document.querySelector('#mark').checkVisibility()")
        browser.tap("#take")
        says(browser, "#operation", "This device operates")
        lab.operator.seat.claim(True)
        says(browser, "#take", "Take over")


def test_viewer_has_no_buttons(browser: Phone, lab: LiveLab) -> None:
    with page_of(lab.dashboard, "127.0.0.1") as page:
        assert page.view_url is not None
        with opened(browser, page.view_url, PHONE):
            says(browser, "#state", "live")
            browser.wait("document.querySelector('#operate-panel').hidden")
            assert browser.run("location.search") == ""


def lose_network(browser: Phone, is_lost: bool) -> None:
    """Cut the page off from the server, or connect it again."""
    browser.send("Network.enable")
    unlimited = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
    browser.send("Network.emulateNetworkConditions", offline=is_lost, **unlimited)


def test_page_shows_the_newest_state_after_a_lost_network(browser: Phone, lab: LiveLab) -> None:
    with page_of(lab.dashboard) as page:
        browser.open(page.url, PHONE)
        says(browser, "#state", "live")
        lose_network(browser, True)
        says(browser, "#state", "no data for")
        # Meanwhile the recording goes on.
        lab.run(5)
        lab.feed(tracks(lab.time_ns, robot(1, 3.0, 2.0)), event(lab.time_ns, "camera_back", "white is back"))
        lab.feed(markers(lab.time_ns), latency(lab.time_ns))
        lose_network(browser, False)
        says(browser, "#state", "live")
        says(browser, "#events", "white is back")
        browser.wait(f"{COUNT.format('#floor .robot')} === 2")
        browser.send("Page.navigate", url="about:blank")
    # The lost network is the only error.
    assert all('"network"' in text for text in browser.console)
    browser.console.clear()


def test_late_positions_are_not_live(browser: Phone, lab: LiveLab) -> None:
    with page_of(lab.dashboard) as page, opened(browser, page.url, PHONE):
        says(browser, "#state", "live")
        lab.run(14)
        lab.states["red"].frames += 90
        lab.feed(markers(lab.time_ns), latency(lab.time_ns - 14 * NS_PER_S, 14.0))
        says(browser, "#state", "late: 14.0 s")
        says(browser, "#cause", "frames/s. Use fewer or smaller images")
        assert browser.run("getComputedStyle(document.querySelector('#state')).color") == "rgb(161, 18, 27)"
        for scheme in ("light", "dark"):
            browser.prefer(scheme)
            assert low_contrasts(browser) == [], scheme
        lab.run(5)
        says(browser, "#state", "stale: 19.0 s")


@pytest.mark.parametrize("size", [PHONE, WALL], ids=["phone", "wall"])
def test_page_fits_the_screen_in_both_schemes(browser: Phone, lab: LiveLab, size: tuple[int, int]) -> None:
    lab.operator.seat.claim(False)
    lab.feed(tracks(lab.time_ns, robot(1, 3.0, 2.0, **TILTED)))
    with page_of(lab.dashboard) as page, opened(browser, page.url, size):
        browser.wait(f"{COUNT.format('figure image')} === 2")
        says(browser, "#robots", "1 robot_1\t3.00\t2.00\t0.10\t29°\t17°")
        browser.tap("#take")
        says(browser, "#operation", "This device operates")
        assert browser.run("document.documentElement.scrollWidth") <= size[0]
        assert browser.run(
            "(e => e.scrollWidth <= e.parentElement.clientWidth)(document.querySelector('#robots'))"
        )
        # Each field and each part of the page has a name for a screen reader.
        assert browser.run(
            "[...document.querySelectorAll('input, select')].every(one => one.labels.length === 1)"
            "&& [...document.querySelectorAll('section')].every(one =>"
            " document.getElementById(one.getAttribute('aria-labelledby'))?.innerText)"
        )
        # A finger hits each button.
        assert browser.run(
            "[...document.querySelectorAll('button, input')].filter(one => one.checkVisibility())"
            ".every(one => one.getBoundingClientRect().height >= 44)"
        )
        for scheme in ("light", "dark"):
            browser.prefer(scheme)
            assert low_contrasts(browser) == [], scheme
