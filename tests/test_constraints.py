"""constraints.txt has one version for each dependency of the package, direct or not, within its bounds."""

import re
import tomllib
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.conftest import ROOT

FILE = ROOT / "constraints.txt"


def read_versions(text: str) -> dict[str, str]:
    """Return the version of each distribution in a file of constraints; every other line is a comment."""
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    rows = [re.fullmatch(r"([A-Za-z0-9._-]+)==([A-Za-z0-9.]+)", line) for line in lines]
    assert [line for line, row in zip(lines, rows, strict=True) if row is None] == []
    return {canonicalize_name(row[1]): row[2] for row in rows if row}


def direct_dependencies() -> Iterator[Requirement]:
    """Yield the dependencies of pyproject.toml, with those of all extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for texts in (project["dependencies"], *project["optional-dependencies"].values()):
        yield from (Requirement(text) for text in texts if not text.startswith("ipsys_log["))


def all_dependencies(versions: dict[str, str]) -> Iterator[tuple[str, Requirement]]:
    """Yield the direct dependencies and those of the tested distributions, each with its origin.

    An installed distribution of another version is not tested: its dependencies may differ.
    """
    waiting = [("pyproject.toml", requirement) for requirement in direct_dependencies()]
    seen = set()
    while waiting:
        origin, requirement = waiting.pop()
        if (origin, str(requirement)) in seen or not _applies(requirement, ""):
            continue
        seen.add((origin, str(requirement)))
        yield origin, requirement
        try:
            if version(requirement.name) != versions.get(canonicalize_name(requirement.name)):
                continue
            further = [Requirement(text) for text in requires(requirement.name) or []]
        except PackageNotFoundError:
            continue
        extras = ["", *requirement.extras]
        waiting += [(requirement.name, one) for one in further if any(_applies(one, name) for name in extras)]


def _applies(requirement: Requirement, extra: str) -> bool:
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def faults(text: str) -> list[str]:
    """List the dependencies without a version in a file of constraints, or with one that they exclude."""
    versions = read_versions(text)
    return [
        f"{origin} needs {requirement}, the file has {versions.get(canonicalize_name(requirement.name))}"
        for origin, requirement in all_dependencies(versions)
        if not requirement.specifier.contains(
            versions.get(canonicalize_name(requirement.name), "0.dev0"), prereleases=True
        )
        or canonicalize_name(requirement.name) not in versions
    ]


def test_every_dependency_has_a_version_within_its_bounds() -> None:
    assert faults(FILE.read_text()) == []


def test_the_file_names_its_python_for_the_setup() -> None:
    (python,) = re.findall(r"(?m)^# Python (\d+\.\d+)$", FILE.read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert Requirement(f"python{project['requires-python']}").specifier.contains(python)
    assert "://" not in FILE.read_text()
