"""Playback: exact spacing of capture times, pauses, steps, seeks and loops with a new session number."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

import ipsys_log as ipsys
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Message
from ipsys_log.sinks.playback import Playback, PlaybackOptions, in_capture_order
from ipsys_log.sinks.streams.poses import NewSession
from ipsys_log.units import NS_PER_S
from tests.sinks.streaming import START_NS, STEP_NS, WaitingClock, tracks, write_tracks

_LIMIT_S = 60.0
LOG = [tracks(number) for number in range(50)]


def playback(clock: WaitingClock, log: Sequence[Message] = LOG, **options: Any) -> Playback:
    def read(start_ns: int) -> Iterator[Message]:
        return (message for message in log if message.log_time_ns >= start_ns)

    times_ns = [message.publish_time_ns for message in log]
    chosen = PlaybackOptions(**options)
    return Playback(read, min(times_ns), max(times_ns), chosen, clock, clock.wait)


def times_of(messages: Iterator[Message], clock: WaitingClock) -> list[tuple[int, int]]:
    """Return the capture time of each played message, and the time of its playing; both from the start."""
    start_ns = clock.now_ns()
    return [
        (message.publish_time_ns - START_NS, clock.now_ns() - start_ns)
        for message in messages
        if not isinstance(message.payload, NewSession)
    ]


@pytest.mark.parametrize("rate", [0.5, 1.0, 2.0])
def test_messages_have_the_spacing_of_their_capture_times(rate: float) -> None:
    clock = WaitingClock()
    played = times_of(playback(clock, rate=rate).messages(), clock)
    assert [captured for captured, _ in played] == [number * STEP_NS for number in range(50)]
    assert max(abs(at_ns - captured / rate) for captured, at_ns in played) < 1000


def test_late_messages_are_played_at_their_capture_time() -> None:
    log = [tracks(0), tracks(2), tracks(1, late_ns=90_000_000), tracks(3), tracks(4)]
    log.sort(key=lambda message: message.log_time_ns)
    assert [message.publish_time_ns for message in log] != sorted(m.publish_time_ns for m in log)
    clock = WaitingClock()
    assert times_of(playback(clock, log).messages(), clock) == [(n * STEP_NS, n * STEP_NS) for n in range(5)]


def test_message_logged_long_after_its_capture_is_played() -> None:
    log = [tracks(0), tracks(1, late_ns=3 * NS_PER_S), tracks(2, late_ns=3 * NS_PER_S)]
    assert [message.publish_time_ns for message in in_capture_order(log)] == [
        message.publish_time_ns for message in log
    ]


def test_capture_order_reads_little_ahead() -> None:
    read = 0

    def endless() -> Iterator[Message]:
        nonlocal read
        while True:
            read += 1
            yield tracks(read)

    next(in_capture_order(endless()))
    assert read <= NS_PER_S // STEP_NS + 1


def test_pause_stops_time_and_step_plays_one_instant() -> None:
    clock = WaitingClock()
    player = playback(clock, start_paused=True)
    played = player.messages()
    assert isinstance(next(played).payload, NewSession)
    player.step()
    assert next(played) is LOG[0]
    player.step()
    assert next(played) is LOG[1]
    assert player.position_s == STEP_NS / NS_PER_S
    clock.time_ns += 100 * NS_PER_S
    assert player.position_s == STEP_NS / NS_PER_S
    start_ns = clock.now_ns()
    player.resume()
    assert next(played) is LOG[2]
    assert clock.now_ns() - start_ns == STEP_NS


def test_seek_and_loop_begin_a_new_session() -> None:
    clock = WaitingClock()
    player = playback(clock, loop=True)
    played = player.messages()
    sessions, first = [next(played).payload.number], next(played)
    player.seek(1.0)
    sessions.append(next(played).payload.number)
    assert (first, next(played)) == (LOG[0], LOG[25])
    rest = [next(played) for _ in range(24 + 2)]
    assert rest[23] is LOG[49]
    sessions.append(rest[24].payload.number)
    assert rest[25] is LOG[0]
    assert sessions == sorted(set(sessions))
    player.loop = False
    assert list(played) == LOG[1:]


def test_restamped_messages_have_the_times_of_the_playback() -> None:
    clock = WaitingClock()
    player = playback(clock, restamp=True, rate=2.0)
    for message in player.messages():
        if not isinstance(message.payload, NewSession):
            assert message.publish_time_ns == clock.now_ns() == player.now_ns()
            assert message.payload.timestamp == message.publish_time_ns


def test_change_of_rate_keeps_the_position() -> None:
    clock = WaitingClock()
    player = playback(clock)
    played = player.messages()
    next(message for message in played if message is LOG[10])
    player.rate = 0.5
    start_ns = clock.now_ns()
    assert next(played) is LOG[11]
    assert clock.now_ns() - start_ns == 2 * STEP_NS


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"rate": 0.0}, "rate 0: give a number from 0.01 to 100"),
        ({"rate": float("nan")}, "rate nan"),
        ({"start_offset_s": -1.0}, "start offset -1.0 s"),
        ({"start_offset_s": 7.0}, "the log ends after 1.960 s"),
    ],
)
def test_impossible_options_are_refused(options: dict[str, Any], text: str) -> None:
    with pytest.raises(IpsysError, match=text):
        playback(WaitingClock(), **options)


def test_logs_are_merged_by_time(tmp_path: Path) -> None:
    early = write_tracks(tmp_path / "early.mcap", 5)
    late = write_tracks(tmp_path / "late.mcap", 5, first=5)
    with ipsys.play(late, early, rate=100) as player:
        times_ns = [row.time_ns for row in player]
    assert times_ns == sorted(times_ns)
    assert times_ns[-1] == START_NS + 9 * STEP_NS


def test_loop_of_the_user_controls_the_player(tmp_path: Path) -> None:
    log = write_tracks(tmp_path / "x.mcap")
    with ipsys.play(log, start_paused=True, start_offset_s=0.4) as player:
        first = player.session
        player.step()
        tracks_now = next(iter(player))
        assert tracks_now.time_ns == START_NS + 10 * STEP_NS
        assert [row.robot for row in tracks_now.tracks] == ["ada", "bob"]
        assert player.position_s == pytest.approx(0.4)
        player.seek(0.0)
        player.step()
        assert next(iter(player)).time_ns == START_NS
        assert player.session > first


def test_stop_ends_a_paused_player(tmp_path: Path) -> None:
    with ipsys.play(write_tracks(tmp_path / "x.mcap"), start_paused=True) as player:
        stopper = Thread(target=player.stop)
        stopper.start()
        begin_s = time.monotonic()
        player.wait()
        assert time.monotonic() - begin_s < _LIMIT_S
        stopper.join()


def test_log_is_not_changed_by_the_player(tmp_path: Path) -> None:
    log = write_tracks(tmp_path / "x.mcap", 3)
    before = log.read_bytes()
    with ipsys.play(log, rate=100) as player:
        assert len(list(player)) >= 1
    assert log.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["x.mcap"]


def test_restamp_moves_the_log_time_too() -> None:
    clock = WaitingClock()
    log = [replace(message) for message in LOG[:3]]
    player = playback(clock, log, restamp=True)
    played = [message for message in player.messages() if not isinstance(message.payload, NewSession)]
    assert [m.log_time_ns - m.publish_time_ns for m in played] == [30_000_000] * 3
