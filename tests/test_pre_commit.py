"""The hooks before a commit run the same checks as scripts/test."""

import re

from tests.conftest import ROOT


def test_hooks_run_the_checks_of_the_test_script() -> None:
    hooks = re.findall(r"(?m)^ +entry: (.+)$", (ROOT / ".pre-commit-config.yaml").read_text())
    lines = (ROOT / "scripts" / "test").read_text().splitlines()
    checks = [line for line in lines if line.startswith((".venv/bin/ruff", ".venv/bin/mypy"))]
    assert hooks == checks != []
