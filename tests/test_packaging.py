"""The publication: a wheel with all files of the package, and the citation of the version."""

import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import typer

from ipsys_log.app.cli.app import app
from tests.conftest import ROOT
from tests.shared_files import make_once

_PACKAGE = ROOT / "ipsys_log"
_PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def package_files() -> set[str]:
    """Return the files of the package in the tree, without compiled ones."""
    paths = [path for path in _PACKAGE.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return {path.relative_to(ROOT).as_posix() for path in paths}


def missing_files(names: set[str]) -> list[str]:
    """Return the files of the package that a wheel lacks."""
    return sorted(package_files() - names)


def _build(folder: Path) -> None:
    tree = folder / "tree"  # setuptools writes into the tree
    shutil.copytree(_PACKAGE, tree / "ipsys_log", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tree)
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index"]
    done = subprocess.run(
        [*command, "--wheel-dir", str(folder), str(tree)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    missing = [name for name in ("pip", "setuptools") if find_spec(name) is None]
    if missing:
        pytest.skip(f"no {', '.join(missing)} to build a wheel with")
    (path,) = make_once(tmp_path_factory, "wheel", _build).glob("*.whl")
    return path


@pytest.mark.slow
def test_wheel_has_every_file_of_the_package(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    assert missing_files(names) == []
    suffixes = {Path(name).suffix for name in names}
    assert {".binpb", ".toml", ".html", ".css", ".js"} <= suffixes
    assert missing_files(names - {"ipsys_log/schemas.binpb"}) == ["ipsys_log/schemas.binpb"]
    assert {name.partition("/")[0] for name in names} == {
        "ipsys_log",
        f"ipsys_log-{_PROJECT['version']}.dist-info",
    }
    assert any(name.endswith("LICENSE") for name in names)


# In this order: the later commands read the files of the earlier ones.
_RUNS = """
simulate -o lab.mcap --width 960 --height 540 --stations 12 --drive-s 0.6 --markers 2
init lab.toml --from lab.mcap
markers -o markers.pdf --ids 0-1 --length 0.1
detect lab.mcap
camera-frame lab.mcap
fit lab.mcap --model rigid
evaluate lab.mcap --model rigid
locate lab.mcap
fuse lab.mcap
smooth lab.mcap
replay lab.mcap --model rigid --plot figures
report lab.mcap --model rigid
info lab.mcap
runs lab.mcap
check lab.mcap
du lab.mcap
cat lab.mcap --topics /rig
plan lab.mcap --model rigid
view lab.mcap --save lab.rrd
export lab.mcap -o tracks.csv
stream lab.mcap --udp 9870 --rate 100
cut lab.mcap -o part.mcap --exclude-topics /truth/tracks
compact lab.mcap -o compact.mcap
verify lab.mcap
diff lab.mcap lab.mcap
repair lab.mcap
catalogue . -o logs.parquet
drive --model-from lab.mcap -o run.mcap --model rigid --lockstep --seconds 1 --port 0
batch check part.mcap --workers 1
"""
# They need cameras, a person, another host, or data of another program: their help alone is printed.
_HELP = """
setup, cameras, calibrate, align, record, measure, calibrate-lab, live, exclude, drift, merge, latency, pack,
score, node, import imsel, import images, import videos, import ros, import truth, import detections,
import pairs, batch replay, batch evaluate, batch verify, batch export, compare,
calibrate-body
"""
# Runs each command of the standard input in this process, and prints those that fail.
_DRIVER = """
import contextlib, io, sys
from pathlib import Path
import ipsys_log
from ipsys_log.app.cli import main

print(ipsys_log.__file__)
for line in sys.stdin:
    sys.argv = ["ipsys", *line.split()]
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said):
            main()
    except SystemExit as end:
        if end.code:
            print("FAILED", line.strip(), end.code, file=sys.stderr)
"""


def commands_of(command: Any, *names: str) -> set[str]:
    """Return the names of all commands, with those of their groups."""
    inner = getattr(command, "commands", None)
    if inner is None:
        return {" ".join(names)}
    return {name for key, value in inner.items() for name in commands_of(value, *names, key)}


def test_every_command_is_tried_from_the_wheel() -> None:
    tried = [" ".join(line.split()) for line in _RUNS.strip().splitlines()]
    tried += [" ".join(name.split()) for name in _HELP.split(",")]
    known = commands_of(typer.main.get_command(app))
    assert {name for name in known if not any(f"{line} ".startswith(f"{name} ") for line in tried)} == set()


@pytest.mark.slow
def test_commands_run_from_the_wheel_in_an_empty_folder(wheel: Path, tmp_path: Path) -> None:
    """All files come from the wheel, and not from the tree: rig, schemas, templates, the example robot."""
    installed, empty = tmp_path / "installed", tmp_path / "empty"
    zipfile.ZipFile(wheel).extractall(installed)
    empty.mkdir()
    lines = [*_RUNS.strip().splitlines(), *(f"{name.strip()} --help" for name in _HELP.split(","))]
    done = subprocess.run(
        [sys.executable, "-c", _DRIVER], input="\n".join(map(str.strip, lines)), cwd=empty,
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(installed)}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.splitlines()[0]).is_relative_to(installed)
    assert [line for line in done.stderr.splitlines() if line.startswith("FAILED")] == [], done.stderr


def test_citation_has_the_version_and_the_license_of_the_package() -> None:
    yaml = pytest.importorskip("yaml", reason="no PyYAML: pip install -e '.[dev]'")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert str(citation["version"]) == _PROJECT["version"]
    assert citation["license"] == _PROJECT["license"]
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    (paper,) = citation["references"]
    assert {"type", "title", "authors"} <= paper.keys()
    assert f"doi:{paper['doi']}" in (ROOT / "README.md").read_text(encoding="utf-8")
    assert paper["authors"][0]["family-names"] == "Ou"
