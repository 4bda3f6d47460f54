"""The distance AB, read with the tape: its entry, its withdrawal, the terminal and the page."""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from urllib.request import Request, urlopen

import pytest

from ipsys_log.app.cli import dialog
from ipsys_log.app.web.app import build_app
from ipsys_log.app.web.server import serve_app
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey.checks import needs_baseline, read_baseline, withdrawal_of
from ipsys_log.live_runs.survey.scene import CameraView, StationaryInterval
from ipsys_log.messages import Measurement, ReferencePoint, Rig
from ipsys_log.statistics.calibration_points import active_baselines, active_measurements

POINTS = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0))
RIG = Rig("lab", "DICT_4X4_100", 0.2, reference_points=POINTS)
KNOWN = replace(RIG, ab_sigma_m=0.001)


class EmptyScene:
    """A scene without markers."""

    model = None
    intervals: Sequence[StationaryInterval] = ()

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.done: list[Measurement] = []

    def views(self, interval: int | None) -> list[CameraView]:  # noqa: ARG002
        return [CameraView("red", 7)]

    def history(self) -> list[Measurement]:
        return self.done

    def add(self, measurements: Sequence[Measurement]) -> None:
        self.done += measurements


def test_baseline_is_no_calibration_point() -> None:
    history = [read_baseline("200.3", RIG, [], 5)]
    assert active_baselines(history) == history
    assert active_measurements(history) == []
    history.append(withdrawal_of(history, "ab"))
    assert active_baselines(history) == []
    assert read_baseline("200.3", RIG, history, 5).id == "ab_2"


@pytest.mark.parametrize(("text", "fault"), [("2.003", "but 200.0 cm in the rig"), ("x", "is not a number")])
def test_wrong_baseline_is_refused(text: str, fault: str) -> None:
    with pytest.raises(IpsysError, match=fault):
        read_baseline(text, RIG, [], 0)


def test_terminal_asks_once_where_the_baseline_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    typed = iter(["9", "200.3"])

    def answer(question: str, usual: str = "") -> str:
        asked.append(question)
        return next(typed)

    monkeypatch.setattr(dialog, "answer", answer)
    for rig in (RIG, KNOWN):
        scene = EmptyScene(rig)
        dialog._ask_baseline(scene)
    assert asked == ["distance from A to B with this tape, cm [Enter: skip]"] * 2
    assert [(one.id, one.timestamp, one.distances[0].distance_m) for one in scene.done] == [("ab", 7, 2.003)]
    assert not needs_baseline(KNOWN, scene.done)


def test_page_saves_lists_and_withdraws_the_baseline() -> None:
    scene = EmptyScene(KNOWN)
    with serve_app(build_app(scene), port=0) as page:
        assert ask(page.url, "scene")["baseline"] == {"names": ["A", "B"], "counts": True}
        saved = ask(page.url, "baseline", {"distance": "200,3"})
        (row,) = saved["history"]["places"]
        assert (row["id"], row["marker"], row["counts"], row["tapes"]) == ("ab", None, True, "B 200.3 cm")
        (row,) = ask(page.url, "undo", {"id": "ab"})["history"]["places"]
        assert not row["counts"]


def ask(url: str, path: str, body: dict[str, str] | None = None) -> Any:
    """Return the answer of the page to a request."""
    data = None if body is None else json.dumps(body).encode()
    headers = {"Content-Type": "application/json", "X-Ipsys": "1"}
    with urlopen(Request(f"{url.rstrip('/')}/api/{path}", data, headers), timeout=20) as answer:
        return json.load(answer)
