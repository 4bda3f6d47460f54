"""Tables and maps of a hall with 24 cameras: no line over 80 columns, and names on the map."""

import io
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from ipsys_log.app.report.contents import contents_tables
from ipsys_log.app.report.figures import legend_label, name_cameras
from ipsys_log.app.report.styles import camera_styles
from ipsys_log.capture.simulation.settings import grid_names

NAMES = grid_names(6, 4)


def channel(schema: str, messages: int, rate_hz: float | None = None, gaps: int = 0) -> dict[str, Any]:
    longest_s = 0.5 if gaps else None
    return {
        "schema": schema, "messages": messages, "rate_hz": rate_hz, "gaps": gaps, "longest_gap_s": longest_s,
    }  # fmt: skip


def contents(names: tuple[str, ...]) -> dict[str, Any]:
    """Return the contents of a log of a hall; camera c2 has lost half of its frames."""
    channels = {"/rig": channel("ipsys.v1.Rig", 1)}
    for name in names:
        channels[f"/cameras/{name}/calibration"] = channel("foxglove.CameraCalibration", 1)
        markers = (
            channel("ipsys.v1.Markers", 450, 15.0, 3)
            if name == "c2"
            else channel("ipsys.v1.Markers", 900, 30.0)
        )
        channels[f"/runs/nodes/cameras/{name}/markers"] = markers
        channels[f"/runs/poly/cameras/{name}/positions"] = channel("ipsys.v1.Positions", 900, 30.0)
    overlap = [
        {
            "run": "poly",
            "cameras": [one, other],
            "count": 90,
            "median_m": n / 1000,
            "p95_m": n / 500,
            "within_95": 0.9,
        }
        for n, (one, other) in enumerate(pairwise(names))
    ]
    return {
        "files": [{"path": "hall.mcap", "bytes": 9_000_000, "messages": 60_000, "chunks": 80}],
        "start": "2026-05-04 10:15:00.000",
        "duration_s": 30.0,
        "cameras": {},
        "channels": dict(sorted(channels.items())),
        "calibration_remarks": [],
        "contradictions": [],
        "overlap": overlap,
        "runs": [],
    }


def printed(found: dict[str, Any]) -> list[str]:
    file = io.StringIO()
    console = Console(file=file, width=80, highlight=False, soft_wrap=True)
    for table in contents_tables(found):
        console.print(table)
    return file.getvalue().splitlines()


def test_contents_of_a_hall_are_short_and_name_the_bad_camera() -> None:
    lines = printed(contents(NAMES))
    assert max(len(line.rstrip()) for line in lines) <= 80
    assert len(lines) < 40
    rows = [line.split() for line in lines]
    assert ["cameras/*/markers", "24", "x", "450-900", "29.4", "3", "(0.5", "s)", "Markers"] in rows
    assert ["cameras/c2/markers", "450", "15.0", "3", "(0.5", "s)", "Markers"] in rows
    assert not any("c3/" in line for line in lines)
    # The pairs that differ most.
    assert any(line.startswith("f3 and f4") for line in lines)
    assert not any(line.startswith("a1 and a2") for line in lines)
    assert "The other 13 pairs differ less. All pairs: --json" in lines


def test_contents_of_a_small_lab_have_all_channels() -> None:
    lines = printed(contents(NAMES[:6]))
    assert sum("/markers" in line or line.strip().startswith("cameras/") for line in lines) == 12
    assert not any("*" in line for line in lines)


def test_many_cameras_have_names_on_the_map_instead_of_a_legend() -> None:
    for names, has_legend in ((NAMES[:6], True), (NAMES, False)):
        axes = Figure().add_subplot()
        styles = camera_styles(names)
        for name in names:
            axes.plot(0, 0, label=legend_label(name, len(names)))
        name_cameras(axes, dict.fromkeys(names, np.zeros(2)), {name: c for name, (c, _) in styles.items()})
        assert len(axes.get_legend_handles_labels()[1]) == (len(names) if has_legend else 0)
        assert [text.get_text() for text in axes.texts] == ([] if has_legend else list(names))
