"""Imports go down the layers, never up or between neighbours; stages never import each other."""

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "ipsys_log"

LAYERS = (
    ("errors",),
    ("units", "plain_text", "extras"),
    ("messages",),
    ("vision",),
    ("log",),
    ("calibration",),
    ("models",),
    ("statistics",),
    ("stages",),
    ("engine",),
    ("capture",),
    ("exchange",),
    ("sinks",),
    ("live_runs",),
    ("tools",),
    ("api",),
    ("app",),
    ("__main__", "__init__"),
)
LAYER = {name: level for level, names in enumerate(LAYERS) for name in names}


def imports(source: str) -> Iterator[str]:
    """Return the dotted names within the package that a source imports."""
    for node in ast.walk(ast.parse(source)):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        yield from (name for name in names if name.startswith("ipsys_log."))


def fault(module: str, imported: str) -> str | None:
    """Return the reason why ``module`` must not import ``imported``; both dotted, without the package."""
    importer, target = module.split("."), imported.split(".")
    if target[0] not in LAYER:
        return None  # a name of the package itself
    if importer[0] == target[0] == "stages":
        if len(importer) > 1 and len(target) > 1 and importer[1] != target[1]:
            return f"stage {module} imports stage {imported}"
    elif importer[0] != target[0] and LAYER[target[0]] >= LAYER[importer[0]]:
        return f"{module} (layer {LAYER[importer[0]]}) imports {imported} (layer {LAYER[target[0]]})"
    return None


def modules() -> list[tuple[str, Path]]:
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found.append((".".join(parts), path))
    return found


def test_imports_go_down() -> None:
    found = {
        fault(module, name.removeprefix("ipsys_log."))
        for module, path in modules()
        for name in imports(path.read_text())
    }
    assert found - {None} == set()


def test_every_module_has_a_layer() -> None:
    assert {name.split(".")[0] for name, _ in modules()} <= set(LAYER)


CLOCKS = {"time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "now", "utcnow"}


def clocks(source: str) -> set[str]:
    """Return calls in a source that read a clock: ``time.time()``, ``datetime.now()`` and others."""
    called = (node.func for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
    return {
        f"{call.value.id}.{call.attr}"
        for call in called
        if isinstance(call, ast.Attribute) and isinstance(call.value, ast.Name)
        if call.value.id in ("time", "datetime") and call.attr in CLOCKS
    }


def test_nothing_but_a_source_reads_a_clock() -> None:
    """A stage that reads a clock could not be replayed. Sources share one clock."""
    reading = {name for name, path in modules() if clocks(path.read_text())}
    assert reading == {"capture.frames"}
