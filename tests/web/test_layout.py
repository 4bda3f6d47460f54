"""The layout of the measuring page: no part too wide, covered, hidden or hard to see, on any screen."""

import fcntl

import pytest

from ipsys_log.app.web.app import build_app
from ipsys_log.app.web.server import serve_app
from ipsys_log.engine.request import Request
from ipsys_log.live_runs.survey.from_log import open_finished_log
from tests.conftest import Unmeasured
from tests.web.contrast import low_contrasts
from tests.web.phone import Phone
from tests.web.test_measuring_page import Recording, save, says, texts_at

PHONE, DESKTOP = (390, 844), (1280, 800)

# The boxes of elements as the user sees them: hidden parts of a scrolled area do not count.
BOXES = """(() => {
  const seen = e => {
    const b = e.getBoundingClientRect();
    const box = [b.left, b.top, b.right, b.bottom];
    for (let p = e.parentElement; p; p = p.parentElement) {
      if (getComputedStyle(p).overflowY !== "auto") continue;
      const c = p.getBoundingClientRect();
      box[1] = Math.max(box[1], c.top);
      box[3] = Math.min(box[3], c.bottom);
    }
    return box;
  };
  const boxes = selector => [...document.querySelectorAll(selector)].filter(e => e.getClientRects().length).map(seen);
  return [boxes("input:not([type=radio]), fieldset span, select"), boxes("#notice, #save"), boxes("#save")[0],
    document.scrollingElement.scrollWidth, innerWidth, innerHeight];
})()"""  # noqa: E501


def meet(one: list[float], other: list[float]) -> bool:
    across, along = (min(one[n + 2], other[n + 2]) - max(one[n], other[n]) for n in (0, 1))
    return across > 0 and along > 0


def check_screen(browser: Phone) -> None:
    """Check the present page in both colour schemes."""
    fields, messages, button, width, screen_width, screen_height = browser.run(BOXES)
    assert width <= screen_width
    assert 0 <= button[1] < button[3] <= screen_height
    assert fields
    assert not [(field, message) for field in fields for message in messages if meet(field, message)]
    for scheme in ("light", "dark"):
        browser.prefer(scheme)
        assert low_contrasts(browser) == [], scheme


@pytest.mark.slow
@pytest.mark.parametrize("size", [PHONE, DESKTOP], ids=["phone", "desktop"])
def test_every_state_of_the_page_fits_the_screen(
    browser: Phone, unmeasured: Unmeasured, size: tuple[int, int]
) -> None:
    log, tape = unmeasured
    with open_finished_log(log, Request()) as scene, serve_app(build_app(scene), port=0) as page:
        a, b, side, height = texts_at(scene, tape, 0)
        browser.open(page.url, size)
        says(browser, "#sight", "is stationary")
        check_screen(browser)
        browser.type("#d-A", a)
        browser.type("#d-B", "1.234")
        says(browser, "#fault-d_B", "looks like metres")
        check_screen(browser)
        browser.run("document.querySelector('#d-B').value = ''")
        browser.type("#d-B", "0.5")
        says(browser, "#verdict", "do not meet, because")
        check_screen(browser)
        browser.run("document.querySelector('#d-B').value = ''")
        browser.type("#d-B", b)
        browser.tap(f"#sides label:nth-of-type({1 if side == 'left' else 2})")
        browser.type("#height", "0.1")
        says(browser, "#save", "despite the warning")
        check_screen(browser)
        browser.run("document.querySelector('#height').value = ''")
        browser.type("#height", height)
        with log.open("r+b") as other:
            fcntl.flock(other, fcntl.LOCK_EX)
            save(browser, "p001")
            # A path is one long word.
            says(browser, "#notice", "another process is writing it")
            check_screen(browser)
        save(browser, "p001")
        says(browser, "#notice", "p001 is in the log")
        check_screen(browser)
        # All entry fields are visible without scrolling.
        assert browser.run(
            "['main', '#entry'].every(part => document.querySelector(part).scrollTop === 0)"
            "&& document.querySelector('#height').getBoundingClientRect().bottom"
            " < document.querySelector('#bar').getBoundingClientRect().top"
        )
        browser.tap("#places button")
        says(browser, "#places", "withdrawn")
        check_screen(browser)


def test_desktop_shows_cameras_and_entry_side_by_side(browser: Phone) -> None:
    with serve_app(build_app(Recording()), port=0) as page:
        browser.open(page.url, DESKTOP)
        says(browser, "#sight", "is stationary")
        seen, entry = browser.run(
            "['#floor', '#form'].map(part => document.querySelector(part).getBoundingClientRect())"
            ".map(box => [box.left, box.right])"
        )
        assert seen[1] < entry[0]
        assert entry[1] - seen[0] > 0.9 * DESKTOP[0]
        assert browser.run(
            "['#seen', '#entry'].map(part => document.querySelector(part))"
            ".every(part => part.scrollHeight <= part.clientHeight)"
        )
