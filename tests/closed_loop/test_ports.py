"""Ports of a robot run: free for UDP and for TCP, and of their own for each robot that has a relay."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.robot_runs.settings import Ports, find_ports
from ipsys_log.live_runs.robot_runs.wheels import Wheels


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
