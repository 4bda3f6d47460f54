"""The measuring page on a phone: taps and keys as input, measurements in the log as output."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.app.web.app import build_app
from ipsys_log.app.web.server import serve_app
from ipsys_log.engine.request import Request
from ipsys_log.live_runs.survey.from_log import FinishedLog, open_finished_log
from ipsys_log.live_runs.survey.scene import CameraView, StationaryInterval
from ipsys_log.messages import (
    CameraPoint,
    CameraPoints,
    Marker,
    Markers,
    Measurement,
    Model,
    ReferencePoint,
    Rig,
    RigMarker,
)
from tests import labs
from tests.conftest import Ipsys, Unmeasured
from tests.test_measure import as_typed, foreign_read
from tests.web.phone import Phone

FETCHED = "performance.getEntriesByType('resource').map(one => one.name)"


@pytest.fixture
def hand(browser: Phone) -> Phone:
    return browser


def fill(hand: Phone, a: str, b: str, side: str, height: str) -> None:
    hand.type("#d-A", a)
    hand.type("#d-B", b)
    hand.tap(f"#sides label:nth-of-type({1 if side == 'left' else 2})")
    hand.type("#height", height)


def save(hand: Phone, name: str) -> None:
    """Save a point as soon as the button is enabled."""
    hand.wait("document.querySelector('#verdict[aria-busy=false]')")
    hand.wait("document.querySelector('#save:enabled')")
    says(hand, "#save", f"Save {name}")
    hand.tap("#save")


def says(hand: Phone, selector: str, text: str) -> None:
    hand.wait(f"document.querySelector({selector!r}).innerText.includes({text!r})")


def texts_at(scene: FinishedLog, tape: Sequence[Measurement], number: int) -> tuple[str, str, str, str]:
    (typed,) = [as_typed(one) for one in tape if scene.intervals[number].covers(one)]
    return typed.distances["A"], typed.distances["B"], typed.side, typed.height


@pytest.mark.slow
def test_point_is_typed_checked_saved_and_withdrawn(hand: Phone, unmeasured: Unmeasured) -> None:
    log, tape = unmeasured
    with open_finished_log(log, Request()) as scene, serve_app(build_app(scene), port=0) as page:
        a, b, side, height = texts_at(scene, tape, 0)
        hand.open(page.url)
        says(hand, "#sight", "is stationary, seen by")
        hand.wait("document.querySelector('#sight').className === 'chip still'")
        hand.wait("document.querySelector('#cameras .still polygon.chosen')")
        hand.wait(f"{FETCHED}.filter(name => name.includes('/picture/')).length === 3")

        fill(hand, a, "1.234", side, height)
        says(hand, "#fault-d_B", "1.234 cm looks like metres")
        hand.wait("document.querySelector('#save').disabled")
        hand.run("document.querySelector('#d-B').value = ''")
        hand.type("#d-B", "0.5")
        says(hand, "#verdict", "do not meet, because")
        assert foreign_read(log) == []
        hand.run("document.querySelector('#d-B').value = ''")
        hand.type("#d-B", b)
        says(hand, "#verdict", "inside the floor")
        hand.wait("document.querySelectorAll('#floor .place').length === 1")
        save(hand, "p001")
        says(hand, "#notice", "p001 is in the log")
        assert [(row.id, row.withdraws) for row in foreign_read(log)] == [("p001", "")]
        says(hand, "#stop", "interval 2/")
        says(hand, "#so-far", "Measured so far: 1 point")
        hand.wait("[...document.querySelectorAll('.cm input')].every(e => e.value === '')")

        hand.tap("#places button")
        says(hand, "#notice", "p001 is withdrawn")
        assert [row.withdraws for row in foreign_read(log)] == ["", "p001"]
        hand.wait("document.querySelectorAll('#places .gone').length === 1")
        hand.tap("#before")
        says(hand, "#stop", "not measured")
        # The page is not wider than the phone, and the browser reports no error.
        assert hand.run("document.documentElement.scrollWidth") == 390
        assert hand.console == []
        assert hand.run(f"{FETCHED}.every(name => name.startsWith(location.origin))")


# A browser, and a fit for its model.
@pytest.mark.slow
def test_side_is_chosen_on_the_map_and_checked_by_the_model(
    hand: Phone, ipsys: Ipsys, unmeasured: Unmeasured, lab: Path
) -> None:
    log, tape = unmeasured
    assert ipsys("fit", lab, "--model", "rigid").code == 0
    assert ipsys("fit", log, "--model-from", lab, "--model", "rigid").code == 0
    with open_finished_log(log, Request()) as scene, serve_app(build_app(scene), port=0) as page:
        assert scene.model is not None
        a, b, side, height = texts_at(scene, tape, 0)
        hand.open(page.url)
        says(hand, "#sight", "is stationary")
        other = "right" if side == "left" else "left"
        for selector, text in (("#d-A", a), ("#d-B", b), ("#height", height)):
            hand.type(selector, text)
        hand.wait("document.querySelectorAll('#floor .maybe').length == 2")
        hand.wait("document.querySelector('#verdict[aria-busy=false]')")
        hand.tap(f"#floor .maybe[aria-label$={other}]")
        says(hand, "#verdict", f"side {side} would fit, not {other}")
        says(hand, "#save", "despite the warning")
        hand.tap(f"#sides label:nth-of-type({1 if side == 'left' else 2})")
        says(hand, "#verdict", "Difference from the present model")
        hand.wait("document.querySelector('#save').innerText === 'Save p001'")
        hand.wait("document.querySelectorAll('#floor path.predicted').length > 0")


class Recording:
    """A lab during a recording: one camera, and markers that are moved by hand."""

    rig: Rig = labs.RIG
    model: Model | None = None
    intervals: Sequence[StationaryInterval] = ()

    def __init__(self) -> None:
        self.speed_m, self.done = 0.0, list[Measurement]()
        self.seen = True

    def views(self, interval: int | None) -> list[CameraView]:
        assert interval is None
        if not self.seen:
            return [CameraView("red", 10**9)]
        path = [CameraPoint(0, n * self.speed_m, 0.1, 2.0) for n in range(9)]
        rows = tuple(CameraPoints(10**9 + n, (point,)) for n, point in enumerate(path))
        measured = tuple((one.id, 0, np.array([0.0, 0.1, 2.0])) for one in self.done)
        return [CameraView("red", rows[-1].timestamp, points=rows, measured=measured)]

    def history(self) -> list[Measurement]:
        return self.done

    def add(self, measurements: Sequence[Measurement]) -> None:
        self.done += measurements


@pytest.mark.slow
def test_moving_marker_cannot_be_saved_during_a_recording(hand: Phone) -> None:
    scene = Recording()
    scene.speed_m = 0.02
    with serve_app(build_app(scene), port=0) as page:
        hand.open(page.url)
        says(hand, "#sight", "Marker 0 moves, as seen by red")
        fill(hand, "170", "190", "left", "10")
        hand.wait("document.querySelector('#verdict .point')")
        says(hand, "#save", "Wait: the marker must not move")
        hand.wait("document.querySelector('#save').disabled")
        scene.seen = False
        says(hand, "#sight", "No camera sees a marker")
        scene.speed_m, scene.seen = 0.0, True
        says(hand, "#sight", "Marker 0 is stationary, seen by red")
        save(hand, "p001")
        says(hand, "#places", "p001 marker 0")
        says(hand, "#so-far", "Measured so far: 1 point (red 1)")
    (saved,) = scene.done
    assert saved.still is not None
    assert (saved.marker_id, saved.side, saved.still.end - saved.still.start) == (0, "left", 8)


# Return whether a tap would hit an element at its present position, without scrolling.
SEEN = """(e => {{ const b = e.getBoundingClientRect();
  const within = b.top >= 0 && b.bottom <= innerHeight;
  return within && e.contains(document.elementFromPoint(b.x + b.width / 2, b.y + b.height / 2));
}})(document.querySelector('{}'))"""


# A browser at several positions of its page.
@pytest.mark.slow
def test_save_button_shows_the_point_to_save(hand: Phone) -> None:
    scene = Recording()
    with serve_app(build_app(scene), port=0) as page:
        hand.open(page.url)
        says(hand, "#sight", "Marker 0 is stationary")
        hand.type("#d-A", "152 cm")
        hand.type("#d-B", "40")
        # The side and the height are not needed.
        says(hand, "#verdict", "do not meet, because")
        hand.run("document.querySelector('#d-B').value = ''")
        hand.type("#d-B", "190")
        hand.wait("document.querySelectorAll('#floor .tape').length === 2")
        hand.tap("#sides label")
        hand.type("#height", "0.1")
        says(hand, "#verdict", "if it is in metres, type 10")
        hand.type("#height", "5")
        says(hand, "#fault-height", "looks like metres")
        hand.run("document.querySelector('#height').value = ''")
        hand.type("#height", "10")
        hand.wait("document.querySelector('#save:enabled')")
        for top in (0, 250, 10_000):
            hand.run(f"document.querySelector('main').scrollTo(0, {top})")
            assert hand.run(SEEN.format("#save"))
            assert hand.run(SEEN.format("#short"))
        said = hand.text("#short")
        assert "height 10.0 cm" in said
        assert said.split(" ± ")[0] in hand.text("#verdict")
        assert hand.run("document.querySelector('#short').getClientRects().length") == 1
        assert hand.run("document.querySelector('#short').offsetHeight") < 30  # one line


def test_cameras_show_visible_markers_before_a_choice(hand: Phone) -> None:
    scene = Recording()
    scene.rig = replace(labs.RIG, markers=(RigMarker(0), RigMarker(3)))
    square = np.array([[0, 0], [60, 0], [60, 60], [0, 60.0]])
    found = Markers(1, (Marker(0, square + 200), Marker(3, square + 400)), 960, 540)
    points = tuple(
        CameraPoints(n, (CameraPoint(0, 0.1, 0.1, 2.0), CameraPoint(3, 0.5, 0.1, 2.0))) for n in range(9)
    )
    views = [
        CameraView("red", 1, None, found, points),
        CameraView("white", 1, None, Markers(1, (), 960, 540)),
    ]
    scene.views = lambda interval: views  # type: ignore[method-assign]
    with serve_app(build_app(scene), port=0) as page:
        hand.open(page.url)
        says(hand, "#sight", "Choose the marker: 0, 3 are visible")
        says(hand, "#cameras button:nth-child(1) span", "sees 0, 3")
        says(hand, "#cameras button:nth-child(2) span", "no marker")
        hand.run("document.querySelector('#marker').value = '3'")
        says(hand, "#cameras button:nth-child(1) span", "sees it")
        says(hand, "#cameras button:nth-child(2) span", "not visible")


# A browser, and several forms.
@pytest.mark.slow
def test_two_distances_need_the_side_and_three_show_residuals(hand: Phone) -> None:
    scene = Recording()
    third = ReferencePoint("C", 2.4, 0.3)
    scene.rig = replace(labs.RIG, reference_points=(*labs.RIG.reference_points, third))
    with serve_app(build_app(scene), port=0) as page:
        hand.open(page.url)
        says(hand, "#sight", "Marker 0 is stationary, seen by red")
        hand.wait("document.querySelector('#sides').hidden")
        for selector, text in (("#d-A", "170"), ("#d-C", "348"), ("#height", "10")):
            hand.type(selector, text)
        says(hand, "#sides", "Seen from A towards C")
        says(hand, "#save", "Still missing: left or right of the line from A to C")
        hand.type("#d-B", "190")
        hand.wait("document.querySelector('#sides').hidden")
        says(hand, "#verdict", "Residuals of the distances")
        save(hand, "p001")
        says(hand, "#places", "p001 marker 0")
    assert [tape.reference for tape in scene.done[0].distances] == ["A", "B", "C"]
