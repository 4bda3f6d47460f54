"""The base installation: its commands work without optional libraries, and others name their extra."""

import json
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from ipsys_log.extras import LIBRARIES
from tests.conftest import ROOT
from tests.test_dependencies import normalize

# Run commands of ipsys where the optional libraries cannot be found, as in the base installation; the
# libraries that only these need are hidden too.
WITHOUT = """
import contextlib, io, json, sys

hidden, commands = json.loads(sys.argv[1])

class Without:
    def __init__(self, finder):
        self._finder = finder

    def __getattr__(self, name):
        return getattr(self._finder, name)

    def find_spec(self, name, path=None, target=None):
        return None if name.partition(".")[0] in hidden else self._finder.find_spec(name, path, target)

sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
from ipsys_log.app.cli import main

results = []
for command in commands:
    sys.argv = ["ipsys", *command]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
    results.append([code, out.getvalue(), err.getvalue()])
print(json.dumps(results))
"""
HIDDEN = [*LIBRARIES, "PIL", "fastcrc", "lxml", "anyio", "markupsafe", "pyarrow"]

RIG = """name = "lab"
dictionary = "DICT_4X4_100"
marker_length_m = 0.2
reference_points = [{ name = "A", x_m = 0.0, y_m = 0.0 }, { name = "B", x_m = 4.88, y_m = 0.0 }]
"""
CAMERA = '[[cameras]]\nname = "{0}"\nsource = "sim:{0}?stations=0"\nwidth = 480\nheight = 270\nrate_hz = 5\n'


def run_without(
    folder: Path, *commands: Sequence[str], hidden: Sequence[str] = HIDDEN
) -> list[tuple[int, str, str]]:
    """Run commands in a process without the optional libraries; return code, stdout and stderr of each."""
    arguments = json.dumps([hidden, commands])
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, arguments], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return [(code, out, err) for code, out, err in json.loads(done.stdout)]


@pytest.fixture
def folder(tmp_path: Path, detected_log: Path, calibration: Path) -> Path:
    """A folder with a rig of simulated cameras, a recording with markers, and the model of another log."""
    (tmp_path / "lab.toml").write_text(RIG + "".join(CAMERA.format(name) for name in ("red", "white")))
    for name, source in (("nodes", "zenoh:red"), ("network", "http://10.0.0.2/video")):
        rig = RIG + CAMERA.format("red").replace("sim:red?stations=0", source)
        (tmp_path / f"{name}.toml").write_text(rig)
    (tmp_path / "red.mp4").touch()
    shutil.copy(detected_log, tmp_path / "lab.mcap")
    shutil.copy(calibration, tmp_path / "model.mcap")
    return tmp_path


# Recordings in real time, and seven commands in a new process.
@pytest.mark.slow
def test_base_commands_without_extras_work(folder: Path) -> None:
    results = run_without(
        folder,
        ["record", "-o", "new.mcap", "--seconds", "1"],
        ["replay", "lab.mcap", "--model", "poly"],
        ["live", "--model-from", "model.mcap", "-o", "live.mcap", "--seconds", "1"],
        ["verify", "live.mcap"],
        ["info", "live.mcap"],
        ["evaluate", "lab.mcap", "--model", "poly", "--details"],
        ["calibrate", "--board", "6x4", "new.mcap"],
    )
    assert [code for code, *_ in results[:-1]] == [0] * 6, results
    assert results[3][1].endswith("the replay is identical to the log\n")
    assert "is not found in any of" in results[-1][2]
    log = (folder / "live.mcap").read_bytes()
    (folder / "live.mcap").write_bytes(log[: len(log) * 3 // 4])
    ((code, out, err),) = run_without(folder, ["repair", "live.mcap"])
    assert (code, "live.mcap repaired" in out) == (0, True), err


REFUSED = {
    "view lab.mcap": "view needs Rerun: pip install 'ipsys_log[view]'",
    "view lab.mcap --save lab.rrd": "view needs Rerun: pip install 'ipsys_log[view]'",
    "live --view --model-from model.mcap -o x.mcap": "--view needs Rerun: pip install 'ipsys_log[view]'",
    "live --mavlink marker_0=127.0.0.1:14550 --model-from model.mcap -o x.mcap": "--mavlink needs pymavlink: "
    "pip install 'ipsys_log[mavlink]'",
    "live --ros2 --model-from model.mcap -o x.mcap": "--ros2 needs Zenoh and rosbags and xxhash: pip install "
    "'ipsys_log[ros2]'",
    "node lab.toml --camera red": "node needs Zenoh: pip install 'ipsys_log[nodes]'",
    "record --rig nodes.toml -o x.mcap": "camera red: the source zenoh:red needs Zenoh: pip install "
    "'ipsys_log[nodes]'",
    "live --foxglove --model-from model.mcap -o x.mcap": "--foxglove needs websockets: pip install "
    "'ipsys_log[foxglove]'",
    "live --web --model-from model.mcap -o x.mcap": "--web needs Starlette and Uvicorn: pip install "
    "'ipsys_log[web]'",
    "export lab.mcap -o x.mcap": "a ROS 2 bag needs rosbags: pip install 'ipsys_log[ros2]'",
    "export lab.mcap -o x.mp4": "a video needs PyAV: pip install 'ipsys_log[video]'",
    "record --rig network.toml -o x.mcap": "camera red: the source http://10.0.0.2/video needs PyAV: pip "
    "install 'ipsys_log[video]'",
    "import videos red=red.mp4 -o x.mcap": "red.mp4: a video needs PyAV: pip install 'ipsys_log[video]'",
    "import ros lab.bag -o x.mcap": "import of ROS bags needs rosbags: pip install 'ipsys_log[ros2]'",
    "import --as detections lab.bag -o x.mcap --rig lab.toml": "import of ROS bags needs rosbags: pip "
    "install 'ipsys_log[ros2]'",
    "setup new_lab": "setup needs Starlette and Uvicorn: pip install 'ipsys_log[web]'",
    "live --rerun --model-from model.mcap -o x.mcap": "--rerun needs Rerun: pip install 'ipsys_log[view]'",
    "report lab.mcap": "report needs Matplotlib and Jinja2: pip install 'ipsys_log[report]'",
    "markers --ids 0-3 --length 0.1": "markers needs Matplotlib: pip install 'ipsys_log[report]'",
    "evaluate lab.mcap --plot x": "--plot needs Matplotlib: pip install 'ipsys_log[report]'",
    **{
        f"{command} --plot x.png": "--plot needs Matplotlib: pip install 'ipsys_log[report]'"
        for command in (
            *("replay lab.mcap", "plan lab.mcap", "align lab.mcap", "latency lab.mcap"),
            "drift lab.mcap",
            *("calibrate lab.mcap --board 6x4", "calibrate --rig lab.toml --board 6x4"),
        )
    },
    "catalogue . -o x.parquet": "catalogue needs PyArrow: pip install 'ipsys_log[table]'",
    "batch check lab.mcap": "batch needs Dask and Dask distributed and Bokeh and cryptography: pip install "
    "'ipsys_log[batch]'",
    "score https://example.org/x.zip": "the address of a dataset needs fsspec: pip install "
    "'ipsys_log[remote]'",
    "record --measure -o x.mcap": "--measure needs Starlette and Uvicorn: pip install 'ipsys_log[web]'",
    "measure lab.mcap": "the measuring page needs Starlette and Uvicorn: pip install 'ipsys_log[web]'",
    "measure --rig lab.toml -o x.mcap": "--measure needs Starlette and Uvicorn: pip install 'ipsys_log[web]'",
}


@pytest.mark.slow
def test_commands_without_their_extra_name_it_and_write_nothing(folder: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    results = run_without(folder, *(command.split() for command in REFUSED))
    for (command, text), result in zip(REFUSED.items(), results, strict=True):
        assert result == (1, "", f"ipsys: {text}\n"), command
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.slow
def test_commands_need_only_their_own_extra(folder: Path) -> None:
    figures = [name for name in HIDDEN if name not in ("matplotlib", "PIL")]
    page = [name for name in HIDDEN if name not in ("jinja2", "markupsafe", "matplotlib", "PIL")]
    viewer = [name for name in HIDDEN if name not in ("rerun", "pyarrow", "PIL")]
    for hidden, command in (
        (figures, "replay lab.mcap --plot x.png"),
        (page, "report lab.mcap --model poly"),
        (viewer, "view lab.mcap --save x.rrd"),
    ):
        ((code, _, err),) = run_without(folder, command.split(), hidden=hidden)
        assert code == 0, err


def test_measuring_page_needs_no_extra_for_figures() -> None:
    hidden = [name for name in HIDDEN if name not in ("starlette", "uvicorn", "anyio", "h11")]
    program = WITHOUT.replace("from ipsys_log.app.cli import main", "import ipsys_log.app.web.server")
    arguments = json.dumps([hidden, []])
    subprocess.run(
        [sys.executable, "-c", program, arguments], cwd=ROOT, check=True, stdout=subprocess.DEVNULL
    )


def test_extras_of_the_errors_are_those_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    installed = packages_distributions()
    named: dict[str, set[str]] = {}
    for module, library in LIBRARIES.items():
        for extra in library.extras:
            named.setdefault(extra, set()).update(normalize(name) for name in installed[module])
    declared = {
        name: {normalize(re.split("[<>=;[]", text)[0]) for text in texts}
        for name, texts in extras.items()
        if name not in ("all", "dev")
    }
    assert named == declared
    assert extras["all"] == [f"ipsys_log[{','.join(declared)}]"]
    assert "ipsys_log[all]" in extras["dev"]
