"""The simulated wheels refuse other robots and ignore invalid commands; the relay loses and delays."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.closed_loop.relay import Relay
from ipsys_log.closed_loop.wheels import Wheels
from ipsys_log.errors import IpsysError


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
