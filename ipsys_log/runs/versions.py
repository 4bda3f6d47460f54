"""Versions of the stages, of their methods and of the models.

A version rises by one with each change of the output for the same input. The parameters of a run name its
versions, except version 1. Versions of packages make no run out of date: they are in its fingerprint.
"""

from __future__ import annotations

from ipsys_log.messages import Run

__all__ = ["VERSIONS", "recorded_version", "version_parameters", "versioned_names"]

VERSIONS: dict[str, int] = {
    "detect": 1,
    "edges": 1,
    "stock": 1,
    "camera-frame": 1,
    "perimeter": 1,
    "pose": 1,
    "fit": 1,
    "rigid": 1,
    "poly": 1,
    "ann": 1,
    "kriging": 1,
    "kriging-regression": 1,
    "rayplane": 1,
    "best": 1,
    "evaluate": 1,
    "locate": 1,
    "fuse": 1,
}
_MOST_DIGITS = 6


def version_parameters(stage: str, method: str = "") -> dict[str, str]:
    """Return the parameters of a run that name the versions of a stage and its method or model.

    A hybrid such as ``rigid+poly`` has the versions of its parts.
    """
    versions = [(name, VERSIONS.get(name, 1)) for name in versioned_names(stage, method)]
    return {name: str(version) for name, version in versions if version != 1}


def versioned_names(stage: str, method: str = "") -> list[str]:
    """Return the parts of a stage that have versions, the stage first."""
    return [stage, *(part for part in method.split("+") if part)]


def recorded_version(run: Run, name: str) -> int:
    """Return the version of a stage, method or model that made a run."""
    text = run.parameters.get(name, "1")
    return int(text) if text.isascii() and text.isdigit() and len(text) <= _MOST_DIGITS else 1
