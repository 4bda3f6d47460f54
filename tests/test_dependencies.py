"""The package declares each distribution that it imports, and none that it does not."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import distribution, packages_distributions
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parent.parent
# The dashboard of Dask, and the certificates of its local workers.
_IMPORTED_BY_DASK = {"bokeh", "cryptography"}


def normalize(distribution: str) -> str:
    """Return the normalised name of a distribution (PEP 503)."""
    return re.sub(r"[-_.]+", "-", distribution).lower()


def declared() -> set[str]:
    """Return the dependencies of pyproject.toml, with those of its extras for users.

    The extra ``all`` names other extras of the package itself.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [
        text
        for name, rows in project["optional-dependencies"].items()
        if name not in ("all", "dev")
        for text in rows
    ]
    names = (re.match(r"[A-Za-z0-9._-]+", text) for text in [*project["dependencies"], *extras])
    return {normalize(name[0]) for name in names if name}


def imported_modules(source: str) -> Iterator[str]:
    """Return the imported top-level modules of a source, also of ``import_module`` with a plain start."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module.split(".")[0]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            name = node.args[0].values[0] if isinstance(node.args[0], ast.JoinedStr) else node.args[0]
            assert isinstance(name, ast.Constant), ast.unparse(node)
            yield str(name.value).split(".")[0]


def imported_distributions() -> dict[str, set[str]]:
    """Return the possible distributions of each third-party module of the package."""
    providers = packages_distributions()
    own = {*sys.stdlib_module_names, "ipsys_log"}
    # The example is a program of its own, for robots.
    files = [path for path in (ROOT / "ipsys_log").rglob("*.py") if path.parent.name != "example_robot"]
    sources = [path.read_text(encoding="utf-8") for path in files]
    modules = {name for source in sources for name in imported_modules(source)} - own
    return {name: {normalize(one) for one in providers[name]} for name in sorted(modules)}


def test_every_import_is_a_declared_dependency() -> None:
    missing = {module: names for module, names in imported_distributions().items() if not names & declared()}
    assert missing == {}


def test_every_declared_dependency_is_imported() -> None:
    used = {name for names in imported_distributions().values() for name in names}
    assert declared() - used == _IMPORTED_BY_DASK


def test_every_dependency_has_a_lower_bound() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert [text for text in project["dependencies"] if ">=" not in text] == []


def test_base_installation_stays_below_500_mb() -> None:
    """The size is that of ``du -m``: blocks of the installed files, with byte code."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    waiting, sizes = [Requirement(text) for text in project["dependencies"]], {}
    while waiting:
        wanted = waiting.pop()
        if normalize(wanted.name) not in sizes and (wanted.marker is None or wanted.marker.evaluate()):
            found = distribution(wanted.name)
            sizes[normalize(wanted.name)] = _size_mb(Path(str(file.locate())) for file in found.files or [])
            waiting += [Requirement(text) for text in found.requires or []]
    assert "av" not in sizes
    assert sum(sizes.values()) + _size_mb((ROOT / "ipsys_log").rglob("*")) < 500, sizes


def _size_mb(files: Iterable[Path]) -> float:
    return sum(512 * file.stat().st_blocks for file in files if file.is_file()) / (1 << 20)
