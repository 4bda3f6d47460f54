"""Rendered sessions of the benchmark of tracks: their markers, their folder, and their continuation."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import Markers, Message
from tests.conftest import ROOT
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import simulate_session

LAB = LabSettings(
    seed=7,
    width=640,
    height=360,
    frames_per_station=2,
    rate_hz=10.0,
    drive_s=1.0,
    markers=2,
    cameras=("red", "white"),
)


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("rendered_sessions")


def make_lab() -> GeometricLab:
    return build_lab(
        GeometricSettings(
            lab=LAB, points=2, clock_offset_s=0.02, frame_delays_s=(0.0, 0.011), corner_noise=0.0
        )
    )


def corners(messages: list[Message]) -> dict[tuple[str, int, int], np.ndarray]:
    return {
        (str(message.camera), message.publish_time_ns, marker.id): marker.corners_px
        for message in messages
        if isinstance(message.payload, Markers)
        for marker in message.payload.markers
    }


@pytest.mark.slow
def test_rendered_markers_are_those_of_the_lab_and_are_kept(
    rendered: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = make_lab()
    first = rendered.rendered_session(lab, tmp_path / "labs")
    exact, seen = corners(list(simulate_session(lab))), corners(first)
    assert len(seen) >= 0.8 * len(exact) > 10
    assert set(seen) <= set(exact)
    # A wrong time by one frame delay (11 ms) moves a robot by more.
    apart_px = np.array([np.linalg.norm(seen[key] - exact[key], axis=1).max() for key in seen])
    assert apart_px.max() < 0.4
    assert [one.topic for one in first] == [one.topic for one in simulate_session(lab)]
    monkeypatch.setattr(rendered, "render", None)  # nothing is rendered again
    again = rendered.rendered_session(lab, tmp_path / "labs")
    assert [one.log_time_ns for one in again] == [one.log_time_ns for one in first]
    np.testing.assert_array_equal(list(corners(again).values()), list(seen.values()))
