"""The progress of a command in a pipe: lines for the steps, and for the tenths of long steps."""

import sys
from pathlib import Path

import pytest

from ipsys_log.api import python_api
from ipsys_log.app.cli import console
from ipsys_log.app.cli.console import progress_bar, progress_lines
from tests.conftest import Ipsys
from tests.publish.packs import SCORED, write_card, write_points_log


def test_long_step_prints_tenths_and_short_one_its_end(capsys: pytest.CaptureFixture[str]) -> None:
    show = progress_lines()
    for done in range(1001):
        show("detect", done, 1000)
    for stage in ("fit rigid", "fit poly"):
        for done in range(8):
            show(stage, done, 7)
            show(stage, done, 7)
    show("cut", 0, 0)
    show("fit joint", 1, None)
    for _ in range(2):  # two logs
        show("cut", 0, 3)
        show("cut", 3, 3)
    tenths = [f"detect: {done} of 1000" for done in range(100, 1001, 100)]
    ends = ["fit rigid: 7 of 7", "fit poly: 7 of 7", "cut: 3 of 3", "cut: 3 of 3"]
    assert capsys.readouterr().err.splitlines() == [*tenths, *ends]


def test_long_work_says_its_duration_once(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 0.0
    monkeypatch.setattr(console, "monotonic", lambda: now_s)
    steps: list[tuple[float, str, int, int]] = [
        *((2.0, "fits", done, 3) for done in range(4)),
        (0.0, "models", 0, 3),  # 8 times the 6 s of the fits, in two processes
        (9.0, "models", 1, 3),
        *((0.16, "detect", done, 100) for done in range(20)),
        *((0.1, "cut", done, 100) for done in range(20)),
        *((5.0, "evaluate poly", done, 10) for done in range(3)),  # a part of models
    ]
    with progress_bar((), jobs=2) as show:
        for took_s, stage, done, total in steps:
            now_s += took_s if done else 0.0
            show(stage, done, total)
    assert capsys.readouterr().err.splitlines() == ["models: about 24 s left", "detect: about 14 s left"]


def test_each_bar_shows_its_own_progress(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(console, "remarks", console.SafeConsole(sys.stderr, stderr=True))
    with progress_bar(()) as show:
        show("models", 0, 3)
        show("evaluate rigid", 0, 5)
        show("models", 1, 3)
    last = capsys.readouterr().err.rpartition("models")[2]
    assert "1/3" in last.partition("evaluate")[0]


def test_whole_work_has_a_bar_beside_those_of_its_steps(tmp_path: Path) -> None:
    log = write_points_log(tmp_path / "lab.mcap")
    steps: list[tuple[str, int, int | None]] = []
    python_api.replay(
        log, models=["rigid", "poly"], until="evaluate", progress=lambda *step: steps.append(step)
    )
    for whole in ("fits", "models"):
        assert [step for step in steps if step[0] == whole] == [(whole, done, 2) for done in range(3)]
    assert steps[:1] == [("fits", 0, 2)]
    steps.clear()
    python_api.verify(log, progress=lambda *step: steps.append(step))
    assert [step for step in steps if step[0] == "runs"] == [("runs", done, 3) for done in range(4)]
    assert steps[0][0] == "runs"
    assert {"evaluate rigid", "evaluate poly"} <= {step[0] for step in steps}


@pytest.mark.slow
def test_pack_prints_its_models_in_a_pipe(tmp_path: Path, ipsys: Ipsys) -> None:
    log, card = write_points_log(tmp_path / "lab.mcap"), write_card(tmp_path / "card.toml")
    models = [word for name in SCORED for word in ("--model", name)]
    done = ipsys("pack", log, "-o", tmp_path / "dataset", "--card", card, *models)
    assert done.code == 0, done.err
    lines = [line.partition(":")[0] for line in done.err.splitlines()]
    fits, evaluations = ([f"{stage} {model}" for model in SCORED] for stage in ("fit", "evaluate"))
    assert lines == [*fits, "fits", *evaluations, "models"]
    scored = ipsys("score", tmp_path / "dataset")
    assert "evaluate poly" in {line.partition(":")[0] for line in scored.err.splitlines()}, scored.err
