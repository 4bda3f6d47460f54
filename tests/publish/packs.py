"""Packs for tests: a small log of calibration points, and changes of a pack with valid checksums."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ipsys_log.engine.output import write_log
from tests.labs import RIG, camera, measure, places, session

CARD = """title = "Small lab"
authors = ["First Author", "Second Author"]
licence = "CC-BY-4.0"
measured = "Tape to two reference points"
published = "2026-05-04"
"""
SCORED = ("rigid", "poly")


def write_points_log(path: Path) -> Path:
    """Write a log with the camera points of 40 calibration points, of which a quarter is held out."""
    rng = np.random.default_rng(5)
    world_m = places(rng, 40)
    seen_m = camera(rng).see(world_m, rng)
    taped_m, _ = measure(world_m, rng)
    write_log(path, session({"red": seen_m}, taped_m, RIG, labels=_label))
    return path


def _label(number: int) -> tuple[str, ...]:
    return ("test",) if number % 4 == 0 else ("train",)


def write_card(path: Path, text: str = CARD) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files of a folder by name."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def change_manifest(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the manifest of a pack, and correct the checksums."""
    path = folder / "croissant.json"
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))
    sign(folder)


def sign(folder: Path) -> None:
    """Write the sizes and the checksums of the files of a pack again, as an attacker can."""
    path = folder / "croissant.json"
    table = json.loads(path.read_text())
    lines = []
    for row in table["distribution"]:
        data = (folder / row["contentUrl"]).read_bytes()
        row |= {"sha256": hashlib.sha256(data).hexdigest(), "contentSize": f"{len(data)} B"}
        lines.append(f"{row['sha256']}  {row['contentUrl']}\n")
    path.write_text(json.dumps(table))
    lines.append(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  croissant.json\n")
    (folder / "SHA256SUMS").write_text("".join(lines))


def change_scores(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the expected scores of a pack, and correct the checksums."""
    path = folder / "scores.json"
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))
    sign(folder)
