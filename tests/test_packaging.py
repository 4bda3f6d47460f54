"""The publication: a wheel with all files of the package, and the citation of the version."""

from __future__ import annotations

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


@pytest.mark.slow
def test_command_runs_from_the_wheel(wheel: Path, tmp_path: Path) -> None:
    """The rig file, the schemas and the templates come from the wheel, and not from the tree."""
    installed = tmp_path / "installed"
    zipfile.ZipFile(wheel).extractall(installed)
    shutil.copy(ROOT / "tests" / "golden" / "v0_1_0.mcap", tmp_path / "lab.mcap")
    commands = (
        ["init", "lab.toml"],
        ["export", "lab.mcap", "-o", "tracks.csv"],
        ["report", "lab.mcap", "--model", "rigid"],
    )
    for command in commands:
        done = subprocess.run(
            [sys.executable, "-m", "ipsys_log", *command], cwd=tmp_path, capture_output=True, text=True,
            env={**os.environ, "PYTHONPATH": str(installed)}, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
    used = subprocess.run(
        [sys.executable, "-c", "import ipsys_log; print(ipsys_log.__file__)"], cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(installed)}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert Path(used.stdout.strip()).is_relative_to(installed)
    assert (tmp_path / "lab.toml").read_bytes() == (_PACKAGE / "rig" / "lab.toml").read_bytes()


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
