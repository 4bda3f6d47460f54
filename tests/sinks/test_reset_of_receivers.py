"""A seek of the player: receivers of every protocol learn that the time goes back."""

import json
import socket
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

import ipsys_log
from tests.ports import free_port
from tests.sinks.streaming import START_NS, STEP_NS, write_tracks
from tests.sinks.test_mavlink_stream import Autopilot
from tests.sinks.test_ros2_stream import stamp_ns
from tests.sinks.test_vrpn_stream import Reader
from tests.sinks.zenoh_listener import ZenohListener
from tests.waiting import wait_until

_LIMIT_S = 240.0
_LATE, _EARLY = 25, 5  # numbers of poses


class Receivers:
    """A receiver of each protocol, for the robot ada."""

    def __init__(self, stack: ExitStack, log: Path) -> None:
        self._udp = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        self._udp.bind(("127.0.0.1", 0))
        self._udp.settimeout(_LIMIT_S)
        self._autopilot = stack.enter_context(closing(Autopilot()))
        vrpn, ros2 = free_port(), free_port()
        self.player = stack.enter_context(
            ipsys_log.play(
                log,
                start_paused=True,
                start_offset_s=1.0,
                robots=["ada"],
                udp=[str(self._udp.getsockname()[1])],
                mavlink=[f"ada={self._autopilot.target}"],
                vrpn=vrpn,
                ros2=ros2,
            )
        )
        self._reader = Reader(stack.enter_context(socket.create_connection(("127.0.0.1", vrpn), _LIMIT_S)))
        self._reader.greet()
        wait_until(
            lambda: any(getattr(stream, "client_count", 0) for stream in self.player.streams),
            "the VRPN client is connected",
        )
        self.ros2 = stack.enter_context(closing(ZenohListener(ros2, "/clock", "/ada/pose")))
        self.ros2.tokens()  # the router answers after it has read the subscriptions
        self._reports, self._steps = self._reader.reports(), 0

    def step(self) -> tuple[dict[str, int], dict[str, int]]:
        """Play the next pose; return its time at each receiver in us, and what tells of a reset."""
        self.player.step()
        self._steps += 1
        datagram = json.loads(self._udp.recv(2048))
        odometry = self._autopilot.next("ODOMETRY")
        report = next(report for report in self._reports if "Pos_Quat" in report.type)
        pose = self.ros2.messages("/ada/pose", self._steps)[-1]
        times_us = {
            "udp": datagram["time_ns"] // 1000,
            "mavlink": odometry.time_usec,
            "vrpn": report.time_ns // 1000,
            "ros2": stamp_ns(pose.header) // 1000,
        }
        resets = {"session": datagram["session"], "seq": datagram["seq"], "counter": odometry.reset_counter}
        return times_us, resets

    def clock_us(self) -> int:
        clock = self.ros2.messages("/clock")[-1].clock
        return (int(clock.sec) * 10**9 + int(clock.nanosec)) // 1000


def test_seek_resets_the_receivers_of_every_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAVLINK20", "1")
    with ExitStack() as stack:
        receivers = Receivers(stack, write_tracks(tmp_path / "x.mcap"))
        (late, before), late_us = receivers.step(), (START_NS + _LATE * STEP_NS) // 1000
        wait_until(lambda: receivers.clock_us() == late_us, f"the clock is {late_us} us", receivers.clock_us)
        receivers.player.seek(0.2)
        (early, after), early_us = receivers.step(), (START_NS + _EARLY * STEP_NS) // 1000
        wait_until(
            lambda: receivers.clock_us() == early_us, f"the clock is {early_us} us", receivers.clock_us
        )
    assert set(late.values()) == {late_us}
    assert set(early.values()) == {early_us}
    assert (before["seq"], after["seq"]) == (1, 1)
    assert after["session"] > before["session"]
    assert after["counter"] == (before["counter"] + after["session"] - before["session"]) % 256
