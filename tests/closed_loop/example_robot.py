"""The example robot of the documentation, as modules of a test."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

from ipsys_log.live_runs.robot_runs.settings import PROGRAM

FOLDER = PROGRAM.parent


def example(name: str) -> ModuleType:
    """Return a module of the example; its folder is in the path only during the import."""
    sys.path.insert(0, str(FOLDER))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(FOLDER))
