"""The track of a robot at any times, from a log with smoothed tracks or with tracks only."""

from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

import ipsys_log as ipsys
from ipsys_log.api.sampled_track import times_in_ns
from ipsys_log.engine.output import write_log
from ipsys_log.messages import Message, Run, Track, Tracks
from ipsys_log.messages.channels import RECORD, SMOOTHED_TRACKS, TRACKS, Channel

EPOCH_NS = 1_700_000_000_000_000_000
STEP_NS = 20_000_000


def make_messages(channel: Channel, run: str, x_m: float) -> list[Message]:
    """Return the rows of a robot that drives along x at 1 m/s, with a record of their stage."""
    velocity, covariance = np.array([1.0, 0.0, 0.0]), 1e-6 * np.eye(3)
    messages = []
    for n in range(10):
        time_ns = EPOCH_NS + n * STEP_NS
        track = Track(
            "ada", 3, x_m + 0.02 * n, 2.0, 0.1, 0.0, covariance, ("red",), True, velocity, 1e-6 * np.eye(3),
            0.001, 0.0, 0.01, age_ns=n * STEP_NS,
        )  # fmt: skip
        messages.append(Message(channel.topic_of(run), time_ns + 5, time_ns, Tracks(time_ns, (track,))))
    return messages


@pytest.fixture
def log_path(tmp_path: Path) -> Path:
    both = [*make_messages(TRACKS, "poly", 1.0), *make_messages(SMOOTHED_TRACKS, "poly", 1.5)]
    only = make_messages(TRACKS, "best", 3.0)
    messages = sorted([*both, *only], key=lambda one: one.log_time_ns)
    end_ns = messages[-1].log_time_ns
    for number, run in enumerate(("best", "poly"), 1):
        record = Run(end_ns, run, "fuse", number=number)
        messages.append(Message(RECORD.topic_of(run), end_ns + number, end_ns, record))
    path = tmp_path / "drive.mcap"
    write_log(path, iter(messages))
    return path


def test_smoothed_tracks_are_read_before_tracks(log_path: Path) -> None:
    times_ns = EPOCH_NS + np.array([0, STEP_NS // 2, 9 * STEP_NS])
    with ipsys.open(log_path) as log:
        smoothed, tracks = log.track_at("ada", times_ns, "poly"), log.track_at("ada", times_ns, "best")
    assert (smoothed.channel, tracks.channel) == ("smoothed_tracks", "tracks")
    np.testing.assert_allclose(smoothed.points_m[:, 0], [1.5, 1.51, 1.68])
    np.testing.assert_allclose(tracks.points_m[:, 0], [3.0, 3.01, 3.18])
    np.testing.assert_allclose(tracks.velocities_m_s, [[1.0, 0, 0]] * 3, atol=1e-9)
    assert (np.diagonal(tracks.covariances_m2, axis1=1, axis2=2) >= 1e-6 * (1 - 1e-9)).all()


def test_times_outside_of_the_track_are_nan(log_path: Path) -> None:
    with ipsys.open(log_path) as log:
        track = log.track_at("ada", [EPOCH_NS - 1, EPOCH_NS, EPOCH_NS + 10 * STEP_NS], "best")
    assert np.isnan(track.points_m[:, 0]).tolist() == [True, False, True]
    assert len(track) == 3


def test_kinds_of_times_are_equal() -> None:
    pandas = pytest.importorskip("pandas")
    wanted = [EPOCH_NS, EPOCH_NS + 1_000]
    start = datetime.fromtimestamp(EPOCH_NS // 1_000_000_000, UTC)
    datetimes = [start, start + timedelta(microseconds=1)]
    other_zone = [time.astimezone(timezone(timedelta(hours=2))) for time in datetimes]
    index = pandas.to_datetime(wanted, utc=True)
    numbers = np.array(wanted, dtype="datetime64[ns]")
    for times in (wanted, np.array(wanted), datetimes, other_zone, index, pandas.Series(index), numbers):
        assert times_in_ns(times).tolist() == wanted
    assert times_in_ns(EPOCH_NS).tolist() == times_in_ns(start).tolist() == [EPOCH_NS]
    exact = pandas.to_datetime([EPOCH_NS + 1], utc=True)
    assert times_in_ns(list(exact)).tolist() == [EPOCH_NS + 1]


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (datetime(2026, 1, 1), "has no time zone"),
        ([1.5], "is not a time; give integers in ns"),
        (["now"], "is not a time"),
    ],
)
def test_times_without_a_zone_are_refused(times: object, said: str) -> None:
    with pytest.raises(ipsys.IpsysError, match=said):
        times_in_ns(times)


def test_naive_pandas_times_are_refused() -> None:
    pandas = pytest.importorskip("pandas")
    index = pandas.to_datetime(["2026-01-01"])
    for times in (index, pandas.Series(index)):
        with pytest.raises(ipsys.IpsysError, match="no time zone"):
            times_in_ns(times)


def test_unknown_robot_and_run_are_named(log_path: Path) -> None:
    with ipsys.open(log_path) as log:
        with pytest.raises(ipsys.IpsysError, match="run poly has no robot 'bob'; it has ada"):
            log.track_at("bob", EPOCH_NS, "poly")
        with pytest.raises(ipsys.IpsysError, match=r"run rigid has no tracks .* best, poly"):
            log.track_at("ada", EPOCH_NS, "rigid")


def test_sampled_track_is_a_table(log_path: Path) -> None:
    pytest.importorskip("pandas")
    with ipsys.open(log_path) as log:
        table = log.track_at("ada", EPOCH_NS + np.arange(3) * 1_000_000, "poly").to_frame()
    assert table["x_m"].round(6).tolist() == [1.5, 1.501, 1.502]
    assert str(table["time"].dt.tz) == "UTC"
    assert {"vx_m_s", "cov_xy_m2", "heading_sigma_rad"} <= set(table.columns)
