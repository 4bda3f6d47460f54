"""Only the table of stages knows their names; other modules use channels and properties of the rows."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from ipsys_log.stages import ENTRIES
from tests.conftest import ROOT

PACKAGE = ROOT / "ipsys_log"
NAMES = {entry.name for entry in ENTRIES}
EXCEPTIONS = {
    "app/cli/app.py": "the panels and the examples of the help, by command",
}


def literals(node: ast.AST | None) -> Iterator[ast.AST]:
    """The names of stages in an expression: a literal, or an element of a tuple, list, set or dict."""
    if isinstance(node, ast.Constant) and node.value in NAMES:
        yield node
    elif isinstance(node, ast.Tuple | ast.List | ast.Set):
        for element in node.elts:
            yield from literals(element)
    elif isinstance(node, ast.Dict):
        for key in node.keys:
            yield from literals(key)


def branches(source: str) -> list[int]:
    """The lines of a source that compare with the name of a stage, have a table of names, or read a row."""
    lines = set()
    for node in ast.walk(ast.parse(source)):
        compared: list[ast.AST | None] = []
        if isinstance(node, ast.Compare):
            compared = [node.left, *node.comparators]
        elif isinstance(node, ast.MatchValue):
            compared = [node.value]
        elif isinstance(node, ast.Subscript):
            compared = [node.slice]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            compared = [*node.args] if node.func.attr == "get" else []
        elif isinstance(node, ast.Tuple | ast.List | ast.Set | ast.Dict):
            compared = [node]
        elif isinstance(node, ast.Attribute) and node.attr == "STAGE" and isinstance(node.value, ast.Name):
            lines.add(node.lineno)
        lines |= {literal.lineno for one in compared for literal in literals(one)}  # type: ignore[attr-defined]
    return sorted(lines)


def test_no_module_branches_on_the_name_of_a_stage() -> None:
    found = {
        path.relative_to(PACKAGE).as_posix(): lines
        for path in sorted(PACKAGE.rglob("*.py"))
        if PACKAGE / "stages" not in path.parents and (lines := branches(path.read_text()))
    }
    assert {name: lines for name, lines in found.items() if name not in EXCEPTIONS} == {}
    assert set(found) == set(EXCEPTIONS), "a module of the list of exceptions needs none"
