"""Libraries that take long to import are imported only by the commands that need them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow  # each test starts the command in a new process

_RUN = """
import json, sys
from ipsys_log.app.cli import main
try:
    main()
except SystemExit as end:
    code = end.code
print(json.dumps([code, sorted(sys.modules)]))
"""


def _command(*arguments: object) -> tuple[int, set[str]]:
    """Run a command in a new process; return its exit code and the modules that it has imported."""
    command = [sys.executable, "-c", _RUN, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    code, modules = json.loads(done.stdout.splitlines()[-1])
    return code, set(modules)


def test_replay_without_work_imports_no_scipy(replayed_lab: Path) -> None:
    before = replayed_lab.read_bytes()
    code, modules = _command("replay", replayed_lab)
    assert code == 0
    assert "ipsys_log.live_runs.pipeline" in modules
    assert not modules & {"scipy", "sklearn", "pandas", "matplotlib"}
    assert not modules & {
        "ipsys_log.api.python_api",
        "ipsys_log.calibration.calibrate",
        "ipsys_log.tools.publish.scoring",
    }
    assert replayed_lab.read_bytes() == before


def test_missing_log_is_an_error_before_the_imports(tmp_path: Path) -> None:
    code, modules = _command("replay", tmp_path / "missing.mcap")
    assert code == 1
    assert not modules & {"numpy", "cv2", "ipsys_log.live_runs.pipeline", "ipsys_log.log.dataset"}


def test_info_does_not_import_the_pipeline(replayed_lab: Path) -> None:
    code, modules = _command("info", replayed_lab)
    assert code == 0
    assert "ipsys_log.live_runs.survey.from_log" in modules
    assert not modules & {"scipy", "sklearn", "ipsys_log.live_runs.pipeline", "ipsys_log.capture"}
