"""The tutorial notebook runs completely."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest

from tests.conftest import ROOT

DOCS = ROOT / "docs"


def test_tutorial_runs_and_draws(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    mpl.use("agg")
    monkeypatch.chdir(DOCS)
    notebook = json.loads((DOCS / "tutorial.ipynb").read_text())
    names: dict[str, Any] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    assert "mean error on the floor" in capsys.readouterr().out
    assert names["error_m"].mean() < 0.05
    assert Path(names["folder"], "tracks.png").stat().st_size > 10_000
