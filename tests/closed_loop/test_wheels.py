"""The simulated wheels refuse other robots and ignore invalid commands; the relay loses and delays."""

import json
import socket
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.capture.frames import Clock
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.robot_runs import wheels as wheels_module
from ipsys_log.live_runs.robot_runs.relay import Relay
from ipsys_log.live_runs.robot_runs.settings import Ports, find_ports
from ipsys_log.live_runs.robot_runs.wheels import Wheels
from ipsys_log.units import NS_PER_S
from tests.closed_loop.example_robot import example


@pytest.fixture
def robot() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(240)
        yield sock


@pytest.fixture
def lines() -> list[str]:
    return []


@pytest.fixture
def wheels(robot: socket.socket, lines: list[str]) -> Iterator[Wheels]:
    opened = Wheels(0, ["ada"], lambda: None, lines.append)
    host, port = opened.address.split(":")
    robot.connect((host, int(port)))
    yield opened
    opened.close()


def test_commands_answer_their_tick(wheels: Wheels, robot: socket.socket) -> None:
    robot.send(b'{"robot": "ada"}')
    wheels.wait_for_robots()
    wheels.tick(7, 0.35, {"ada": 12})
    assert json.loads(robot.recv(2048)) == {"tick": 7, "time_s": 0.35, "positions": 12}
    command = {"robot": "ada", "left_m_s": 0.1, "right_m_s": -0.2, "state": "driving", "waypoint": 2}
    robot.send(json.dumps({**command, "tick": 6}).encode())  # late
    robot.send(json.dumps({**command, "tick": 7, "x_m": 1.5, "y_m": 2.5, "time_ns": 99}).encode())
    (answer,) = wheels.answers(7)
    assert (answer.left_m_s, answer.right_m_s, answer.state, answer.waypoint) == (0.1, -0.2, "driving", 2)
    assert (answer.x_m, answer.y_m, answer.position_time) == (1.5, 2.5, 99)


class SteppingClock(Clock):
    """A clock that advances at each reading."""

    def __init__(self, step_s: float) -> None:
        super().__init__()
        self._ns, self._step_ns = 0, round(step_s * NS_PER_S)

    def now_ns(self) -> int:
        self._ns += self._step_ns
        return self._ns


def open_wheels(
    robot: socket.socket, lines: list[str], clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> Wheels:
    monkeypatch.setattr(wheels_module, "Clock", lambda: clock)
    opened = Wheels(0, ["ada"], lambda: None, lines.append)
    host, port = opened.address.split(":")
    robot.connect((host, int(port)))
    return opened


def test_suspended_simulator_still_takes_the_answer(
    robot: socket.socket, lines: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each reading of the clock is an hour later: the simulator was suspended meanwhile."""
    with closing(open_wheels(robot, lines, SteppingClock(3600.0), monkeypatch)) as opened:
        robot.send(b'{"robot": "ada"}')
        opened.wait_for_robots()
        robot.send(b'{"robot": "ada", "tick": 1, "left_m_s": 1, "right_m_s": 1}')
        assert [answer.left_m_s for answer in opened.answers(1)] == [1.0]
    assert lines == []


def test_slow_program_is_named_before_it_is_an_error(
    robot: socket.socket, lines: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wheels_module, "_TURN_S", 0.001)
    monkeypatch.setattr(wheels_module, "_SAID_S", 0.01)
    monkeypatch.setattr(wheels_module, "_LONGEST_S", 0.1)
    with closing(open_wheels(robot, lines, SteppingClock(1.0), monkeypatch)) as opened:
        with pytest.raises(IpsysError, match=r'ada: its program has not sent \{"robot": "ada"\} to 127'):
            opened.wait_for_robots()
        robot.send(b'{"robot": "ada"}')
        assert list(opened.receive(60.0)) == []
        with pytest.raises(IpsysError, match=r"ada: its program has not sent a command for 0\.1 s"):
            opened.answers(1)
    assert lines[1:] == ["ada: waits until its program sends a command; Ctrl-C to end"]


def test_stop_ends_the_wait_for_answers(wheels: Wheels, robot: socket.socket) -> None:
    robot.send(b'{"robot": "ada"}')
    wheels.wait_for_robots()
    wheels.stop()
    assert wheels.answers(1) == []


def test_robot_waits_for_every_position_in_lockstep(wheels: Wheels, robot: socket.socket) -> None:
    """A robot that goes on without a position makes another log on a slow machine."""

    class SlowPositions:
        count = turns = 0

        def receive(self, wait_s: float, _now_s: float) -> None:
            self.turns += wait_s > 0
            self.count += self.turns % 100 == 99

    positions = SlowPositions()
    example("robot").wait_for_positions(positions, 3, 0.0, robot, b'{"robot": "ada"}')
    assert positions.count == 3
    wheels.wait_for_robots()  # the robot has shown meanwhile that it is there


def test_robot_ends_after_its_simulator(wheels: Wheels, robot: socket.socket) -> None:
    """A killed simulator sends no end, and its robots must not wait for ever."""
    wheels.close()
    robot.settimeout(0.01)
    with pytest.raises(ConnectionRefusedError):
        example("robot").wait_for_tick(robot, b'{"robot": "ada"}')


def test_program_of_another_robot_is_refused(wheels: Wheels, robot: socket.socket, lines: list[str]) -> None:
    robot.send(b'{"robot": "eve"}')
    assert list(wheels.receive(60.0)) == []
    assert json.loads(robot.recv(2048)) == {"end": True, "error": "no robot eve; the robots are ada"}
    assert lines == ["a program asks for no robot eve; the robots are ada"]


@pytest.mark.parametrize(
    "datagram",
    [
        *(b"", b"\xff", b"[]", b"{}", b'{"robot": 1}', b'{"robot": []}', b"[" * 2000),
        b'{"robot": "ada", "tick": 1}',
        b'{"robot": "ada", "tick": 1, "left_m_s": NaN, "right_m_s": 0}',
        b'{"robot": "ada", "tick": 1, "left_m_s": 1e999, "right_m_s": 0}',
        b'{"robot": "ada", "tick": "x", "left_m_s": 0, "right_m_s": 0}',
        b'{"robot": "ada", "tick": 1, "left_m_s": 0, "right_m_s": 0, "waypoint": null}',
        b'{"robot": "ada", "tick": 1, "left_m_s": 0, "right_m_s": 0, "time_ns": 5}',
    ],
)
def test_invalid_commands_are_ignored(wheels: Wheels, robot: socket.socket, datagram: bytes) -> None:
    robot.send(b'{"robot": "ada"}')
    wheels.wait_for_robots()
    robot.send(datagram)
    assert list(wheels.receive(60.0)) == []


def test_command_from_another_address_is_ignored(wheels: Wheels, robot: socket.socket) -> None:
    robot.send(b'{"robot": "ada"}')
    wheels.wait_for_robots()
    host, port = wheels.address.split(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.sendto(b'{"robot": "ada", "tick": 1, "left_m_s": 1, "right_m_s": 1}', (host, int(port)))
    assert list(wheels.receive(60.0)) == []


def test_port_in_use_is_named(wheels: Wheels) -> None:
    port = int(wheels.address.split(":")[1])
    with pytest.raises(IpsysError, match=f"--port {port}: is in use, perhaps by another ipsys; end"):
        Wheels(port, ["ada"], lambda: None, print)


@settings(max_examples=30)
@given(
    st.integers(0, 2**31),
    st.floats(0.0, 0.9),
    st.integers(0, 10**9),
    st.lists(st.integers(0, 10**8), min_size=1, max_size=60),
)
def test_relay_delays_all_and_loses_by_its_seed(
    seed: int, loss: float, delay_ns: int, gaps_ns: list[int]
) -> None:
    outcomes = []
    for _ in range(2):
        relay, now_ns, times_ns, arrived = Relay(loss, delay_ns, seed), 0, {}, []
        for number, gap_ns in enumerate(gaps_ns):
            now_ns += gap_ns
            times_ns[str(number).encode()] = now_ns
            relay.put(str(number).encode(), now_ns)
            arrived += [(datagram, now_ns) for datagram in relay.take(now_ns)]
        arrived += [(datagram, now_ns + delay_ns) for datagram in relay.take(now_ns + delay_ns)]
        assert all(arrival_ns - times_ns[datagram] >= delay_ns for datagram, arrival_ns in arrived)
        assert [datagram for datagram, _ in arrived] == sorted((d for d, _ in arrived), key=int)
        assert (relay.arrived, relay.forwarded) == (len(gaps_ns), len(arrived))
        outcomes.append(arrived)
    assert outcomes[0] == outcomes[1]


def test_relay_loses_the_given_share() -> None:
    relay = Relay(0.05, 0, 1)
    for _ in range(4000):
        relay.put(b"x", 0)
    # Four standard deviations of the binomial distribution.
    assert len(relay.take(0)) == pytest.approx(0.95 * 4000, abs=4 * (4000 * 0.05 * 0.95) ** 0.5)


def test_port_that_is_free_only_for_udp_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """The system offers ports that other programs use for TCP; the search goes on to another port."""
    offered: list[int] = []

    class Offering(socket.socket):
        def bind(self, address: Any) -> None:
            is_offer = self.type == socket.SOCK_DGRAM and address[1] == 0
            if is_offer and len(offered) < 2:
                address = address[0], taken.getsockname()[1]
                offered.append(address[1])
            super().bind(address)

    with socket.create_server(("127.0.0.1", 0)) as taken:
        monkeypatch.setattr(socket, "socket", Offering)
        ports = find_ports(0, 1, has_server=False, has_relay=False)
    assert len(offered) == 2
    assert offered[0] not in (ports.wheels, *ports.positions)


@pytest.mark.parametrize("kind", [socket.SOCK_DGRAM, socket.SOCK_STREAM], ids=["udp", "tcp"])
def test_wanted_port_in_use_is_named(kind: int) -> None:
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        if kind == socket.SOCK_STREAM:
            taken.listen()
        with pytest.raises(IpsysError, match=f"--port {port}: port {port} is in use"):
            find_ports(port, 1, has_server=False, has_relay=False)


def test_robots_share_a_server_unless_they_have_relays() -> None:
    shared = find_ports(0, 2, has_server=True, has_relay=False)
    assert shared.server is not None
    assert shared == Ports(shared.wheels, shared.server, (shared.server,) * 2, ())
    relayed = find_ports(0, 2, has_server=True, has_relay=True)
    assert len({relayed.wheels, relayed.server, *relayed.positions, *relayed.relays}) == 6
    datagrams = find_ports(0, 2, has_server=False, has_relay=True)
    assert (datagrams.server, len(datagrams.positions), len(datagrams.relays)) == (None, 2, 2)


def test_wheels_bind_any_free_port_and_name_it() -> None:
    """No search gives their port, so no other program can take it before."""
    ports = find_ports(0, 1, has_server=False, has_relay=False)
    wheels = [Wheels(ports.wheels, ["ada"], lambda: None, print) for _ in range(2)]
    numbers = {int(each.address.rpartition(":")[2]) for each in wheels}
    for each in wheels:
        each.close()
    assert len(numbers - {0}) == 2
