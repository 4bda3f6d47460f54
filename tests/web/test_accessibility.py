"""Accessibility of all pages: axe-core finds no serious or critical fault, light and dark."""

import shutil
from pathlib import Path

import pytest

from ipsys_log.api import python_api as api
from ipsys_log.app.first_day.lab_folder import LabFolder
from ipsys_log.app.web.app import build_app
from ipsys_log.app.web.server import serve_app
from ipsys_log.app.web.setup import SetupApp
from ipsys_log.exchange.lab_files import simulated_lab_texts, write_new
from ipsys_log.messages import CameraModel, Model
from tests.conftest import Unmeasured
from tests.waiting import wait_until
from tests.web.axe import serious_faults
from tests.web.dashboards import BEGIN_NS, LiveLab, event, frame, latency, markers, page_of, robot, tracks
from tests.web.phone import Phone
from tests.web.test_dashboard_browser import press
from tests.web.test_dashboard_state import LENS, Stream, pairs_of_a_level_camera
from tests.web.test_measuring_page import Recording, says
from tests.web.test_setup_browser import focus

# A browser, and axe-core from the registry of npm.
pytestmark = pytest.mark.slow

PHONE, DESKTOP = (390, 844), (1280, 900)
STEPS = ("rig", "cameras", "intrinsics", "alignment", "drive", "points", "accuracy", "live")


def check(browser: Phone, place: object) -> None:
    """Check the present page in both colour schemes, with all its folded parts."""
    browser.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    for scheme in ("light", "dark"):
        browser.prefer(scheme)
        assert serious_faults(browser) == [], (place, scheme)


def leave(browser: Phone) -> None:
    browser.send("Page.navigate", url="about:blank")
    browser.wait("location.href === 'about:blank'")


def test_dashboard_has_no_serious_fault(browser: Phone, tmp_path: Path) -> None:
    model = Model(0, "poly", (CameraModel("red", (), pairs=pairs_of_a_level_camera()),))
    lab = LiveLab(tmp_path / "monday.mcap", model, {"red": LENS}, [Stream()])
    for n in range(30):
        time_ns = lab.time_ns = BEGIN_NS + n * 100_000_000
        lab.feed(tracks(time_ns, robot(0, 1 + n / 50, 1.0), robot(9, 0.5, 2.5)), latency(time_ns))
        lab.feed(frame(time_ns), markers(time_ns))
    for kind in ("camera_lost", "camera_moved", "mark"):
        lab.feed(event(lab.time_ns, kind, f"an event of kind {kind}", "white"))
    with page_of(lab.dashboard) as page:
        browser.open(page.url, PHONE)
        browser.wait("document.querySelector('figure image')")
        browser.tap("#take")
        says(browser, "#operation", "This device operates")
        check(browser, "live")
        lab.end()
        says(browser, "#state", "recording ended")
        check(browser, "ended")
        leave(browser)


def test_measuring_page_has_no_serious_fault(browser: Phone) -> None:
    with serve_app(build_app(Recording()), port=0) as page:
        browser.open(page.url, PHONE)
        browser.wait("document.querySelector('#fields input')")
        check(browser, "live")
        leave(browser)


@pytest.fixture
def folder(tmp_path: Path, unmeasured: Unmeasured, replayed_log: Path, recorded: Path) -> LabFolder:
    """A folder in which all steps are done."""
    path = tmp_path / "lab"
    path.mkdir()
    folder = LabFolder(path)
    write_new(simulated_lab_texts(folder.rig_file))
    aligned = Path(shutil.copy(unmeasured.log, path / "alignment.mcap"))
    api.replay(aligned, until="camera-frame", method="pose")
    shutil.copy(replayed_log, path / "calibration.mcap")
    shutil.copy(recorded, path / "live.mcap")
    return folder


def test_setup_page_has_no_serious_fault(browser: Phone, folder: LabFolder) -> None:
    setup = SetupApp(folder)
    with serve_app(setup.app, None, 0) as page:
        browser.open(page.url, PHONE)
        for name in STEPS:
            browser.wait(f"document.querySelector('#step-{name}')")
            browser.run(f"location.hash = '{name}'")
            browser.wait(f"document.querySelector('#step-{name}[aria-current]')")
            check(browser, name)
        leave(browser)
        setup.session.close()


def test_last_steps_of_the_setup_need_only_the_keyboard(browser: Phone, folder: LabFolder) -> None:
    setup = SetupApp(folder)
    with serve_app(setup.app, None, 0) as page:
        browser.open(page.url, DESKTOP)
        browser.wait("document.querySelector('#step-accuracy')")
        focus(browser, "#step-accuracy")
        press(browser, "Enter", "\r")
        says(browser, "h2", "7. Calibration")
        focus(browser, "#calibrate-lab")
        press(browser, "Enter", "\r")
        wait_until(
            lambda: setup.session.jobs.present is not None and setup.session.jobs.present.ended,
            "the job has ended",
        )
        says(browser, "#operation", "This device operates")
        # The end of the job leaves the keyboard in the panel.
        browser.wait("document.querySelector('#panel').contains(document.activeElement)")
        browser.reload()  # the page is not drawn again while the keyboard moves
        browser.wait("document.querySelector('#onward')")
        focus(browser, "#onward")
        press(browser, "Enter", "\r")
        says(browser, "h2", "8. Live view")
        focus(browser, "#live")
        leave(browser)
        setup.session.close()
