"""The first day in a browser: from an empty folder to tracked robots, on any screen, by keyboard."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.app.first_day.lab_folder import LabFolder
from ipsys_log.app.first_day.steps import Status, read_progress
from ipsys_log.app.web.server import serve_app
from ipsys_log.app.web.setup import SetupApp
from ipsys_log.capture.simulation.live_lab import LIVE_SETTINGS, image_index, plan_live_lab
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import TRACKS
from tests.waiting import wait_until
from tests.web.contrast import low_contrasts
from tests.web.phone import Phone
from tests.web.test_dashboard_browser import press
from tests.web.test_measuring_page import FETCHED, says

# A browser.
pytestmark = pytest.mark.slow

PHONE, DESKTOP, WALL = (390, 844), (1280, 900), (2560, 1440)
STEPS = ("rig", "cameras", "intrinsics", "alignment", "drive", "points", "accuracy", "live")
# The simulated robots drive for 4 s in each direction: both logs have their whole path.
DRIVE_S, LIVE_BYTES = 15, 15_000_000
# A step lasts longer on a busy machine than a change of a page.
JOB_ENDED = "document.querySelector('#job').hidden"


class Visitor:
    """A user of the page who counts the own inputs: taps and typed fields."""

    def __init__(self, browser: Phone) -> None:
        self.browser, self.inputs = browser, 0

    def wait(self, script: str) -> None:
        self.browser.wait(script)

    def tap(self, selector: str) -> None:
        """Tap a button; the page draws its panel before the button can be hit again."""
        self.wait(f"document.querySelector({selector!r} + ':not(:disabled)')?.checkVisibility()")
        self.browser.tap(selector)
        self.inputs += 1

    def run_job(self, selector: str) -> None:
        """Start a job, and wait until its step is done."""
        self.tap(selector)
        self.wait(f"document.querySelector('#onward') && {JOB_ENDED}")


def visit(browser: Phone, url: str, size: tuple[int, int] = PHONE) -> None:
    """Leave the present page, which asks its server every second, and open another one."""
    leave(browser)
    browser.open(url, size)


def leave(browser: Phone) -> None:
    browser.send("Page.navigate", url="about:blank")
    browser.wait("location.href === 'about:blank'")


def unexpected(browser: Phone) -> list[str]:
    """Return the messages of the browser, without those on refused entries (409), which are intended."""
    return [text for text in browser.console if "(Conflict)" not in text]


def focus(browser: Phone, selector: str) -> None:
    """Move the focus with the tabulator key only; the fields and the steps come before a button."""
    for _ in range(60):
        if browser.run(f"document.activeElement?.matches({selector!r}) ?? false"):
            return
        press(browser, "Tab")
    raise AssertionError(f"the tabulator key does not reach {selector}")


@contextmanager
def serving(folder: Path) -> Iterator[str]:
    setup = SetupApp(LabFolder(folder))
    with serve_app(setup.app, None, 0) as server:
        yield server.url
        setup.session.close()
        assert server.exceptions.count == 0, server.exceptions.first


@contextmanager
def opened(browser: Phone, folder: Path, size: tuple[int, int] = PHONE) -> Iterator[str]:
    """Open the page of a folder, and leave it at the end; the browser must have reported no error."""
    with serving(folder) as url:
        browser.open(url, size)
        yield url
        leave(browser)
    assert unexpected(browser) == []


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "a_long_name_of_a_folder_for_a_lab"
    path.mkdir()
    return path


def drive_errors_m(log: Path) -> np.ndarray:
    """Return the 2D errors of the robots' tracks in a live log against the simulated truth, (n,), in m."""
    lab, errors_m = plan_live_lab(LIVE_SETTINGS), []
    with Session([log]) as session:
        for tracks in session.payloads(session.topics(TRACKS, "joint")):
            time_s = lab.time_of(
                image_index(round(tracks.timestamp * LIVE_SETTINGS.rate_hz / 1e9), lab.images)
            )
            for track in tracks.tracks:
                if track.id in lab.drive.ahead_s:
                    true = lab.drive.pose_at(track.id, time_s)
                    errors_m.append(np.hypot(track.x_m - true.x_m, track.y_m - true.y_m))
    return np.array(errors_m)


def track(visitor: Visitor, url: str, log: Path) -> None:
    """Start the live view on the present page, and see three robots on the dashboard."""
    visitor.tap("#live")
    visitor.wait("document.querySelector('#open-live')")
    visit(visitor.browser, url + "live/")
    visitor.inputs += 1
    visitor.wait("document.querySelectorAll('#floor .robot').length === 3")
    # One device operates the setup and the dashboard.
    says(visitor.browser, "#operation", "This device operates")
    wait_until(lambda: log.stat().st_size > LIVE_BYTES, "the recording has the whole path")
    visit(visitor.browser, url + "#live")


def test_empty_folder_becomes_a_lab_with_tracked_robots(browser: Phone, folder: Path) -> None:
    visitor = Visitor(browser)
    with serving(folder) as url:
        browser.open(url)
        visitor.tap("#simulate")
        visitor.tap("#onward")
        says(browser, "h2", "4. Alignment")
        visitor.run_job("#align")
        browser.wait("document.querySelectorAll('.shaft').length >= 3")
        visitor.tap("#onward")
        visitor.tap("#drive")
        visitor.wait("document.querySelectorAll('.covered').length > 10")
        visitor.wait(f"document.querySelector('#drive-views').dataset.seconds >= {DRIVE_S}")
        visitor.tap("#finish")
        visitor.wait(f"document.querySelector('#onward') && {JOB_ENDED}")
        visitor.tap("#onward")
        leave(browser)
    # Restarted in the middle, another server continues with the same state.
    with serving(folder) as url:
        visit(browser, url)
        says(browser, "#state", "5 of 8")
        says(browser, "h2", "6. Calibration points")
        visitor.run_job("#sheet")
        visitor.tap("#onward")
        visitor.run_job("#calibrate-lab")
        says(browser, "#panel", "Enough: the expected mean error of each camera is")
        visitor.tap("#onward")
        track(visitor, url, folder / "live.mcap")
        assert visitor.inputs == 13  # at most 15; docs/your-lab.md names the number
        visitor.tap("#stop")
        visitor.wait(JOB_ENDED)
        says(browser, "#state", "8 of 8")
        # Four more points, and a second recording.
        browser.run("location.hash = 'points'")
        visitor.run_job("#sheet")
        says(browser, "#panel", "calibration_2.mcap")
        browser.run("location.hash = 'accuracy'")
        visitor.run_job("#calibrate-lab")
        browser.run("location.hash = 'live'")
        track(visitor, url, folder / "live_2.mcap")
        visitor.tap("#stop")
        visitor.wait(JOB_ENDED)
        assert browser.run(f"{FETCHED}.every(name => name.startsWith(location.origin))")
        leave(browser)
    assert unexpected(browser) == []
    assert [step.status for step in read_progress(LabFolder(folder)).steps] == [Status.DONE] * 8
    for log, most_m in (("live.mcap", 0.0035), ("live_2.mcap", 0.002)):
        errors_m = drive_errors_m(folder / log)
        assert len(errors_m) > 10
        assert np.median(errors_m) < most_m, log


def test_intrinsics_and_points_are_measured_on_pages(browser: Phone, folder: Path) -> None:
    visitor = Visitor(browser)
    with opened(browser, folder) as url:
        visitor.tap("#simulate")
        visitor.wait("document.querySelector('#onward')")
        browser.run("location.hash = 'intrinsics'")
        visitor.wait("document.querySelector('#board')")
        browser.run("document.querySelector('#board').value = '6'")
        visitor.tap("#calibrate-red")
        says(browser, "#board-fault", "is not a board")
        browser.run("document.querySelector('#board').value = '6x4'")
        visitor.tap("#calibrate-red")
        visitor.wait("document.querySelectorAll('.kept').length > 3")
        visitor.wait(JOB_ENDED)
        says(browser, "#panel", "from red.yaml")
        browser.run("location.hash = 'points'")
        visitor.tap("#measure")
        visitor.wait("document.querySelector('#open-measure')")
        visit(browser, url + "measure/")
        visitor.wait("document.querySelector('#sight').innerText.includes('are visible')")
        # A tap on a marker in an image chooses it; a tap is repeated if the image is drawn again meanwhile.
        tap = "dispatchEvent(new MouseEvent('click', {bubbles: true}))"
        visitor.wait(
            f"document.querySelector('#cameras [data-marker]').{tap}"
            " && document.querySelector('#marker').value !== ''"
        )
        assert browser.run("document.querySelector('#setup').href") == url + "#points"
        visit(browser, url + "#points")
        says(browser, "#panel", "0 points measured in this log so far")
        visitor.tap("#finish")
        visitor.wait(JOB_ENDED)
        # Without a point, the step is not done.
        says(browser, "#panel", "0 points measured")


def test_every_step_fits_every_screen_in_both_schemes(browser: Phone, folder: Path) -> None:
    with opened(browser, folder, DESKTOP) as url:
        browser.wait("document.querySelector('#marker_length_m')")
        browser.run("document.querySelector('#marker_length_m').value = '20'")
        browser.tap("#save")
        says(browser, "#marker_length_m-fault", "0.2 if it is in cm")
        browser.wait("document.activeElement.id === 'marker_length_m'")
        # The typed value survives the polling of the state.
        assert browser.run("document.querySelector('#marker_length_m').value") == "20"
        browser.wait("document.querySelector('#marker_length_m').ariaInvalid === 'true'")
        browser.tap("#simulate")
        browser.wait("document.querySelector('#onward')")
        for size in (PHONE, DESKTOP, WALL):
            visit(browser, url, size)
            for name in STEPS:
                browser.wait(f"document.querySelector('#step-{name}')")
                browser.run(f"location.hash = '{name}'")
                browser.wait(f"document.querySelector('#step-{name}[aria-current]')")
                assert browser.run("document.scrollingElement.scrollWidth <= innerWidth"), (size, name)
                for scheme in ("light", "dark"):
                    browser.prefer(scheme)
                    assert low_contrasts(browser) == [], (size, name, scheme)
