"""The figure of tracks: breaks of lines, regions along the way, and hand-overs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from ipsys_log.app.report.drive_figures import DrawnTrack, draw_tracks, read_drawn_tracks
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Message, Track, Tracks
from ipsys_log.messages.channels import TRACKS

EPOCH_NS, STEP_NS = 1_700_000_000_000_000_000, 50_000_000


def write_tracks(path: Path) -> None:
    """Write a robot that drives 1 m along x; from its middle on, another camera sees it."""
    messages = []
    for n in range(21):
        time_ns = EPOCH_NS + n * STEP_NS + (n > 15) * 10 * STEP_NS
        cameras = ("red",) if n < 10 else ("white",)
        track = Track("ada", 3, 0.05 * n, 2.0, 0.1, 0.0, 4e-6 * np.eye(3), cameras, True)
        messages.append(Message(TRACKS.topic_of("poly"), time_ns, time_ns, Tracks(time_ns, (track,))))
    write_log(path, iter(messages))


def test_drawn_track_has_breaks_regions_and_hand_overs(tmp_path: Path) -> None:
    write_tracks(tmp_path / "drive.mcap")
    with Session([tmp_path / "drive.mcap"]) as session:
        tracks = read_drawn_tracks(session, "poly")
    ada = tracks["ada"]
    assert np.isnan(ada.line_m[:, 0]).nonzero()[0].tolist() == [16]
    assert ada.hand_overs_m.tolist() == [[0.5, 2.0]]
    assert np.diff(ada.regions[0][:, 0]).min() > 0.15
    axes = Figure().add_subplot()
    enlarged = draw_tracks(axes, tracks)
    # The region of 95 % has a radius of 4.9 mm: ten times that is visible, twenty times is too large.
    assert enlarged == 10
    ellipse = axes.patches[0]
    assert isinstance(ellipse, Ellipse)
    np.testing.assert_allclose(ellipse.get_width() / enlarged, 2 * np.sqrt(-2 * np.log(0.05)) * 0.002)


def test_log_without_tracks_has_none_to_draw(tmp_path: Path) -> None:
    write_tracks(tmp_path / "drive.mcap")
    with Session([tmp_path / "drive.mcap"]) as session:
        assert read_drawn_tracks(session, "best") == {}
    assert draw_tracks(Figure().add_subplot(), {}) >= 1


def test_tracks_of_many_robots_look_different() -> None:
    line_m, none_m = np.array([[0.0, 0.0], [1.0, 1.0]]), (np.empty((0, 2)), np.empty((0, 2, 2)))
    tracks = {f"robot_{n}": DrawnTrack(line_m, none_m, np.empty((0, 2))) for n in range(20)}
    axes = Figure().add_subplot()
    draw_tracks(axes, tracks)
    lines = [line for line in axes.lines if str(line.get_label()).startswith("robot")]
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == 20
