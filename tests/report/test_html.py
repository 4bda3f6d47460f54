"""``ipsys report``: one page without a network, safe with any name, and readable on a phone."""

import os
import pty
import re
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.app.report.accuracy import Accuracy, read_accuracy
from ipsys_log.app.report.html import render_report
from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.dataset import Session
from ipsys_log.messages import MEASUREMENTS_TOPIC, Measurement, Message, ReferencePoint, Suspect
from tests import labs
from tests.conftest import ROOT, Ipsys
from tests.report.browser import visit
from tests.report.conftest import lab_messages, many_models
from tests.web.contrast import low_contrasts
from tests.web.phone import phone

EVIL = "<script>window.ran=true</script><img src='http://evil.example/x.png'>"


def hostile(messages: list[Message]) -> list[Message]:
    """Return the same session with names that contain HTML and scripts."""

    def spoiled(message: Message) -> Message:
        payload = message.payload
        if isinstance(payload, Measurement):
            payload = replace(payload, id=f"{payload.id}{EVIL}")
        return replace(message, payload=payload)

    return [spoiled(message) for message in messages]


@pytest.fixture(scope="module")
def hostile_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    points = (*labs.RIG.reference_points, ReferencePoint(r"$\frac{" + EVIL, 2.0, 2.0))
    rig = replace(labs.RIG, name=EVIL, reference_points=points)
    path = tmp_path_factory.mktemp("page") / "lab.mcap"
    write_log(path, hostile(lab_messages(rig)))
    return path


def with_suspect(accuracies: list[Accuracy]) -> list[Accuracy]:
    """Give the last model an outlier with a correction."""
    *rest, last = accuracies
    assert last.evaluation is not None
    suspect = Suspect(
        f"m01{EVIL}", ("red",), np.array([0.1, 0.0, 0.02]), 9.3, "side", "would fit on the other side",
        np.array([1.0, 2.0, 0.1]),
    )  # fmt: skip
    return [*rest, replace(last, evaluation=replace(last.evaluation, suspects=(suspect,)))]


@pytest.fixture(scope="module")
def page(hostile_log: Path) -> str:
    """Return a page with all parts: all models, outliers, uncertain tape, hostile names."""
    outcomes = replay([hostile_log], Request(models=("poly",)), "evaluate")
    with Session([hostile_log]) as session:
        return render_report(session, with_suspect(many_models(read_accuracy(session, outcomes))))


def test_names_out_of_a_log_are_escaped(page: str) -> None:
    assert "&lt;script&gt;window.ran=true&lt;/script&gt;" in page
    assert "<script" not in page
    assert not re.search(r"<img[^>]+evil", page)


@pytest.mark.parametrize("width", [390, 1200])
def test_the_page_in_a_browser(page: str, width: int, tmp_path: Path) -> None:
    seen = visit(page, width, tmp_path)
    assert seen.console == []
    assert seen.remote == []
    assert seen.scripts == 0
    assert not seen.ran
    assert seen.width <= width
    assert len(seen.images) >= 7
    for alt, natural_width, natural_height, shown in seen.images:
        assert alt
        assert natural_width > 100
        assert natural_height > 50
        assert 0.8 * min(width, 450) < shown <= width
    for words in (
        "Mean distance to the tape points", "Recommended model", "Models", "Error map",
        "Number of calibration points",
        "Outliers", "Uncertain tape measurements", "Extrapolation",
        "Consistency of the covariance", "Runs and versions", "seed=0", "would fit on the other side",
        "100.0, 200.0, 10.0", "rigid+kriging-regression", "Camera white",
    ):  # fmt: skip
        assert words in seen.text, words


def test_browser_check_finds_forbidden_actions(tmp_path: Path) -> None:
    bad = visit(
        '<body><script>window.ran = true; console.error("boo")</script><img src="http://evil.example/x.png">'
        '<div style="width:700px">wide</div></body>',
        390,
        tmp_path,
    )
    assert any("boo" in line for line in bad.console)
    assert "http://evil.example/x.png" in bad.remote
    assert (bad.ran, bad.scripts) == (True, 1)
    assert bad.width > 390
    assert bad.images[0][1] == 0


def test_the_figures_are_those_of_the_evaluation(page: str, hostile_log: Path) -> None:
    with Session([hostile_log]) as session:
        (accuracy,) = read_accuracy(session, replay([hostile_log], Request(models=("poly",)), "evaluate"))
    pooled = next(row for row in accuracy.rows(True) if row.camera == "")
    assert pooled.error_3d is not None
    assert pooled.error_3d.p95_m is not None
    assert f"{pooled.error_3d.mean_m * 100:.2f} <span" in page
    assert f"{pooled.error_3d.p95_m * 100:.2f}</td>" in page


def test_report_is_repeatable_and_leaves_the_log_unchanged(ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "lab.mcap"
    write_log(log, lab_messages())
    done = ipsys("report", log, "--model", "poly")
    assert done.code == 0, done.err
    assert done.out == f"{tmp_path / 'lab.html'} written: open it in a browser\n"
    first, held = (tmp_path / "lab.html").read_bytes(), log.read_bytes()
    done = ipsys("report", log, "--model", "poly", "--html", tmp_path / "again.html")
    assert done.code == 0
    assert (tmp_path / "again.html").read_bytes() == first
    # Without options, the evaluation in the log is enough, and no other model is evaluated.
    done = ipsys("report", log, "--html", tmp_path / "again.html")
    assert "evaluated before: poly; to add models: ipsys evaluate" in done.err
    assert (tmp_path / "again.html").read_bytes() == first
    assert log.read_bytes() == held
    assert {path.name for path in tmp_path.iterdir()} == {"lab.mcap", "lab.html", "again.html"}


def test_report_evaluates_changed_points_with_the_models_of_the_log(ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "lab.mcap"
    write_log(log, lab_messages())
    assert ipsys("evaluate", log, "--model", "poly").code == 0
    with Session([log]) as session:
        point = session.payloads([MEASUREMENTS_TOPIC])[-1].id
    assert ipsys("exclude", log, point, "--reason", "sag").code == 0
    assert ipsys("report", log).code == 0
    with Session([log]) as session:
        assert [run.run for run in session.runs() if run.stage == "evaluate"] == ["poly", "poly_2"]
    assert "evaluated before: poly;" in ipsys("report", log).err


def test_report_asks_on_a_terminal_before_it_evaluates(tmp_path: Path) -> None:
    log = tmp_path / "lab.mcap"
    write_log(log, lab_messages())
    before = log.read_bytes()
    ours, theirs = pty.openpty()
    os.write(ours, b"n\n")
    command = [sys.executable, "-m", "ipsys_log", "report", str(log)]
    environment = os.environ | {"TERM": "xterm", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment, check=False, timeout=240
    )
    os.close(theirs)
    shown = b""
    with suppress(OSError):  # the end of the terminal
        while part := os.read(ours, 1 << 16):
            shown += part
    os.close(ours)
    text = " ".join(shown.decode().split())
    assert done.returncode == 0, text
    assert "no model is evaluated yet. Evaluate all models now?" in text
    assert "no page was written" in text
    assert log.read_bytes() == before
    assert [*tmp_path.iterdir()] == [log]


def test_report_into_a_new_log_stands_beside_that_one(ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "lab.mcap"
    write_log(log, lab_messages())
    before = log.read_bytes()
    (tmp_path / "new").mkdir()
    done = ipsys("report", log, "--model", "rigid", "-o", tmp_path / "new" / "result.mcap")
    assert done.code == 0, done.err
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"result.mcap", "result.html"}
    assert log.read_bytes() == before


def test_a_page_that_cannot_be_written_is_refused_beforehand(ipsys: Ipsys, tmp_path: Path) -> None:
    log = tmp_path / "lab.mcap"
    write_log(log, lab_messages())
    before = log.read_bytes()
    (tmp_path / "link.html").symlink_to(log)
    for target in (tmp_path / "missing" / "x.html", tmp_path, log, tmp_path / "link.html"):
        done = ipsys("report", log, "--model", "rigid", "--html", target)
        assert done.code == 1
        assert done.out == ""
        assert len(done.err.splitlines()) == 1
        assert f"--html {target}" in done.err
    assert log.read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"lab.mcap", "link.html"}


def test_one_camera_and_one_height_give_a_report(tmp_path: Path) -> None:
    log = tmp_path / "level.mcap"
    write_log(log, lab_messages(heights=(0.1,), cameras=1))
    outcomes = replay([log], Request(models=("rigid",)), "evaluate")
    with Session([log]) as session:
        page = render_report(session, read_accuracy(session, outcomes))
    assert "cm (2D, model rigid)" in page
    assert "None" not in re.sub(r"data:[^\"]+", "", page)
    assert "nan" not in re.sub(r"data:[^\"]+", "", page)


def test_a_model_of_another_log_has_a_page(ipsys: Ipsys, tmp_path: Path) -> None:
    """The model is not fitted again: there is no cross-validation and no learning curve."""
    for name in ("old", "new"):
        write_log(tmp_path / f"{name}.mcap", lab_messages(count=30 if name == "old" else 20))
    assert ipsys("fit", tmp_path / "old.mcap", "--model", "poly").code == 0
    done = ipsys("report", tmp_path / "new.mcap", "--model-from", tmp_path / "old.mcap")
    assert done.code == 0, done.err
    page = (tmp_path / "new.html").read_text()
    assert "held out" in page
    assert "Number of calibration points" not in page


TABLES = """[...document.querySelectorAll("table")].map(table => {
  const scroll = table.parentElement, name = table.querySelector("tbody th");
  scroll.scrollLeft = 9999;
  const box = scroll.getBoundingClientRect(), start = name ? name.getBoundingClientRect().left : box.left;
  return [table.scrollWidth - box.width, scroll.scrollLeft, Math.abs(start - box.left),
    Boolean(table.closest("#models"))];
})"""


def test_page_fits_screens_and_follows_the_colour_scheme(page: str, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    file.write_text(page, encoding="utf-8")
    with phone(tmp_path / "browser") as browser:
        for size in ((390, 844), (1280, 800)):
            browser.open(file.as_uri(), size)
            # Six screens of 1280 x 900 px with folded details; a link opens its section.
            assert size[0] < 1280 or browser.run("document.documentElement.scrollHeight") <= 6 * 900
            browser.run("location.hash = 'tape'")
            assert browser.run("document.querySelector('#tape').closest('details')?.open") is True
            browser.run("document.querySelectorAll('details').forEach(part => part.open = true)")
            assert browser.run("document.scrollingElement.scrollWidth <= innerWidth")
            tables = browser.run(TABLES)
            assert len(tables) >= 6
            for hidden_px, scrolled_px, name_px, is_of_models in tables:
                # Wide parts scroll, and the name of the row stays visible.
                assert scrolled_px >= hidden_px - 1
                assert name_px < 1
                assert hidden_px < 1 or size[0] < 1280 or not is_of_models
            backgrounds = {}
            for scheme in ("light", "dark"):
                browser.prefer(scheme)
                assert low_contrasts(browser) == [], scheme
                backgrounds[scheme] = browser.run("getComputedStyle(document.body).backgroundColor")
                assert browser.run("getComputedStyle(document.images[0]).backgroundColor") == (
                    "rgba(0, 0, 0, 0)" if scheme == "light" else "rgb(255, 255, 255)"
                )
            assert backgrounds["light"] == "rgb(255, 255, 255)" != backgrounds["dark"]
        dark = {"name": "prefers-color-scheme", "value": "dark"}
        browser.send("Emulation.setEmulatedMedia", media="print", features=[dark])
        assert browser.run("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
        assert low_contrasts(browser) == []


def test_one_exchanged_pair_does_not_change_the_title(tmp_path: Path) -> None:
    def exchanged(message: Message) -> Message:
        taped = message.payload
        if not isinstance(taped, Measurement) or taped.id != "m13":
            return message
        to_a, to_b = taped.distances
        swap = replace(to_a, distance_m=to_b.distance_m), replace(to_b, distance_m=to_a.distance_m)
        return replace(message, payload=replace(taped, distances=swap))

    pages = []
    for name, messages in (
        ("right", lab_messages(cameras=1)),
        ("wrong", list(map(exchanged, lab_messages(cameras=1)))),
    ):
        write_log(tmp_path / f"{name}.mcap", messages)
        outcomes = replay([tmp_path / f"{name}.mcap"], Request(models=("rigid", "poly")), "evaluate")
        with Session([tmp_path / f"{name}.mcap"]) as session:
            pages.append(render_report(session, read_accuracy(session, outcomes)))
    titles = [re.search("<h1>Mean distance to the tape points: ([0-9.]+) cm", page) for page in pages]
    assert titles[0] is not None
    assert titles[1] is not None
    assert float(titles[1][1]) == pytest.approx(float(titles[0][1]), abs=0.11)
    right, wrong = (" ".join(re.sub("<[^>]+>", "", page).split()) for page in pages)
    assert "gross outlier" not in right
    assert "The gross outlier m13 is excluded from all errors, figures and advice. With it, the mean" in wrong
    assert "look exchanged" in wrong
    assert "with gross outliers, mean" in wrong
