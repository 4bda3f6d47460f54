"""The robots on the display of a recording: named robots first, in cm and degrees, as many as fit."""

import io
import math
from dataclasses import replace

import numpy as np
from rich.console import Console

from ipsys_log.app.report.cameras import robots_table
from ipsys_log.messages import Track


def shown(tracks: list[Track]) -> list[list[str]]:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(robots_table({track.robot: track for track in tracks}))
    return [line.split() for line in console.export_text().splitlines()]


def test_positions_are_in_cm_and_headings_in_degrees() -> None:
    ada = Track("ada", 7, 1.234, 0.5, 0.1, math.radians(90), cameras=("red", "white"))
    bare = Track("marker_3", 3, -0.05, 2.0, 0.0)
    tilted = replace(ada, robot="bob", id=8, rotation_rad=np.array([math.radians(20), 0.0, 0.0]))
    heading, first, third, second = shown([bare, ada, tilted])
    assert heading == ["robot", "x", "cm", "y", "cm", "z", "cm", "heading", "cameras"]
    assert first == ["ada", "123.4", "50.0", "10.0", "90", "deg", "red,", "white"]
    assert third[4:8] == ["90", "deg,", "tilt", "20"]
    assert second == ["marker_3", "-5.0", "200.0", "0.0", "-"]


def test_robots_that_do_not_fit_are_counted() -> None:
    tracks = [Track(f"marker_{n}", n, 0.0, 0.0, 0.0) for n in range(40)]
    rows = shown([*tracks, Track("zoe", 99, 0.0, 0.0, 0.0)])
    assert rows[1][0] == "zoe"
    named = [row[0] for row in rows[2:-1]]
    assert named == [f"marker_{n}" for n in range(len(named))]
    assert rows[-1] == ["and", str(41 - 1 - len(named)), "more"]
