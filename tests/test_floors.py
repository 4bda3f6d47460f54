"""Imports go down the floors of the house, never up; stages never import each other."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "ipsys_log"

FLOORS = {
    "errors": 0, "messages": 0, "plain_text": 0, "rig": 0, "rig_slips": 0, "units": 0,
    "geometry": 1,
    "models": 2, "log": 2,
    "stages": 3, "offline": 3, "calibration": 3, "measuring": 3, "sources": 3, "sinks": 3, "formats": 3,
    "runs": 4, "recording": 4, "pipeline": 4, "scenes": 4, "restore": 4, "compare": 4, "verify": 4,
    "report": 4, "web": 4,
    "cli": 5, "__main__": 6, "__init__": 6,
}  # fmt: skip
# On one floor, only downwards in this order.
ORDER_IN_PIPELINE = [
    "runs", "recording", "pipeline", "scenes", "restore", "compare", "verify", "report", "web",
]  # fmt: skip


def imports(source: str) -> Iterator[str]:
    """Dotted names within the package that a source imports."""
    for node in ast.walk(ast.parse(source)):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        yield from (name for name in names if name.startswith("ipsys_log."))


def fault(module: str, imported: str) -> str | None:
    """Why ``module`` must not import ``imported``; both dotted, without the package."""
    here, there = module.split("."), imported.split(".")
    if there[0] not in FLOORS:
        return None  # a name of the package itself
    if FLOORS[there[0]] > FLOORS[here[0]]:
        return f"{module} (floor {FLOORS[here[0]]}) imports {imported} (floor {FLOORS[there[0]]})"
    if here[0] == there[0] == "stages" and len(here) > 1 and len(there) > 1 and here[1] != there[1]:
        return f"stage {module} imports stage {imported}"
    if {here[0], there[0]} == {"models", "log"}:
        return f"{module} imports its neighbour {imported}"
    if here[0] in ORDER_IN_PIPELINE and there[0] in ORDER_IN_PIPELINE:
        order = ORDER_IN_PIPELINE.index
        if order(there[0]) > order(here[0]):
            return f"{module} imports {imported}, which rests on it"
    return None


def modules() -> list[tuple[str, Path]]:
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found.append((".".join(parts), path))
    return found


@pytest.mark.parametrize(("module", "path"), modules(), ids=[name for name, _ in modules()])
def test_imports_go_down(module: str, path: Path) -> None:
    wrong = [fault(module, name.removeprefix("ipsys_log.")) for name in imports(path.read_text())]
    assert [text for text in wrong if text] == []


@pytest.mark.parametrize(
    ("module", "imported"),
    [
        ("geometry.markers", "log.reader"),
        ("stages.detect", "pipeline"),
        ("stages.detect", "stages.locate"),
        ("log.reader", "models.poly"),
        ("runs.tasks", "recording.waiting"),
        ("messages", "geometry"),
    ],
)
def test_the_guard_sees_an_import_that_goes_up(module: str, imported: str) -> None:
    assert fault(module, imported) is not None


def test_every_module_has_a_floor() -> None:
    assert {name.split(".")[0] for name, _ in modules()} <= set(FLOORS)


CLOCKS = {"time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "now", "utcnow"}


def clocks(source: str) -> set[str]:
    """Calls in a source that read a clock: ``time.time()``, ``datetime.now()`` and the like."""
    called = (node.func for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
    return {
        f"{call.value.id}.{call.attr}"
        for call in called
        if isinstance(call, ast.Attribute) and isinstance(call.value, ast.Name)
        if call.value.id in ("time", "datetime") and call.attr in CLOCKS
    }


def test_nothing_but_a_source_reads_a_clock() -> None:
    """Law 2: a stage that read a clock would not replay. Sources have one, all the same one."""
    reading = {name for name, path in modules() if clocks(path.read_text())}
    assert reading == {"sources.frames"}


def test_the_guard_sees_a_clock() -> None:
    assert clocks("import time\nstamp = time.time_ns()") == {"time.time_ns"}
    assert clocks("from datetime import datetime\nstamp = datetime.now()") == {"datetime.now"}
    assert clocks("import time\ntime.sleep(1)") == set()
