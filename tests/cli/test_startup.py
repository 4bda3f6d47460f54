"""Libraries that take long to import are imported only by the commands that need them."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main

from ipsys_log.app.cli.app import app, purposes

_RUN = """
import json, sys
from ipsys_log.app.cli import main
try:
    main()
except SystemExit as end:
    code = end.code
print(json.dumps([code, sorted(sys.modules)]))
"""
_STAGES, _REPLAY = "ipsys_log.engine.graph", "ipsys_log.live_runs.pipeline"
_HEAVY = {
    *("numpy", "cv2", "scipy", "sklearn", "pandas", "matplotlib", "rerun", "mcap", "dask", "fsspec", "av"),
    *("rich.markdown", "starlette", "ipsys_log.api.python_api", "ipsys_log.app.cli.batch", _STAGES, _REPLAY),
    *("ipsys_log.calibration.calibrate", "ipsys_log.tools.publish.scoring"),
}
# The heavy modules of each command: LOG has all results of poly, and NONE does not exist.
_NEEDED = {
    "--help": {"rich.markdown"},  # which the library of the command line imports for any help
    "replay NONE": set(),
    "info NONE": set(),
    "cat LOG --topics /rig": {"mcap", "numpy"},
    "info LOG --sizes": {"mcap", "numpy"},
    "info LOG": {"mcap", "numpy", "cv2"},
    "info LOG --runs": {"mcap", "numpy", "cv2", _STAGES},
    "check LOG": {"mcap", "numpy", "cv2", _STAGES},
    "replay LOG": {"mcap", "numpy", "cv2", _STAGES, _REPLAY},
    "evaluate LOG --model poly --seed 1 -o NEW": {"mcap", "numpy", "cv2", "scipy", _STAGES, _REPLAY},
}


@pytest.mark.slow  # each case starts the command in a new process
@pytest.mark.parametrize("words", _NEEDED)
def test_command_imports_what_it_needs(words: str, replayed_lab: Path, tmp_path: Path) -> None:
    places = {"LOG": replayed_lab, "NONE": tmp_path / "none.mcap", "NEW": tmp_path / "new.mcap"}
    before = replayed_lab.read_bytes()
    arguments = [str(places.get(word, word)) for word in words.split()]
    command = [sys.executable, "-c", _RUN, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    code, modules = json.loads(done.stdout.splitlines()[-1])
    assert code == int("NONE" in words), done.stderr
    assert _HEAVY.intersection(modules) == _NEEDED[words]
    assert replayed_lab.read_bytes() == before


def test_first_help_screen_states_the_purposes_of_the_docstrings() -> None:
    commands = typer.main.get_group(app).commands
    assert purposes() == {name: str(commands[name].help).partition("\n\n")[0] for name in purposes()}
