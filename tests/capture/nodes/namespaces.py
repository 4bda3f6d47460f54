"""Hosts as network namespaces of Linux: a node and a centre that reach each other only through a relay."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

import pytest

__all__ = ["CENTRE_IP", "RELAY_IP", "Hosts", "three_hosts"]

# Each link has its own network. The node knows only the address of the relay.
NODE_IP, RELAY_IP = "10.91.0.2", "10.91.0.1"
CENTRE_IP, RELAY_AT_CENTRE_IP = "10.92.0.2", "10.92.0.1"


class Hosts(NamedTuple):
    """The names of the namespaces."""

    node: str
    relay: str
    centre: str


def in_host(host: str, *command: str) -> list[str]:
    """Return a command that runs in a namespace."""
    return ["ip", "netns", "exec", host, *command]


@contextmanager
def three_hosts() -> Iterator[Hosts]:
    """Make the namespaces; skip the test if this is not allowed."""
    hosts = Hosts(*(f"ipsys_{os.getpid()}_{name}" for name in Hosts._fields))
    with ExitStack() as stack:
        for host in hosts:
            _add(host, stack)
        _connect(hosts.node, NODE_IP, hosts.relay, RELAY_IP)
        _connect(hosts.centre, CENTRE_IP, hosts.relay, RELAY_AT_CENTRE_IP)
        yield hosts


def _add(host: str, stack: ExitStack) -> None:
    if shutil.which("ip") is None:
        pytest.skip("network namespaces need the program ip of iproute2")
    done = subprocess.run(["ip", "netns", "add", host], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"no right to make a network namespace: {done.stderr.strip()}")
    stack.callback(subprocess.run, ["ip", "netns", "del", host], check=True)


def _connect(one: str, one_ip: str, other: str, other_ip: str) -> None:
    """Connect two namespaces by a cable of their own."""
    names = f"to_{other_ip.split('.')[1]}", f"of_{one_ip.split('.')[1]}"
    _ip("link", "add", names[0], "netns", one, "type", "veth", "peer", "name", names[1], "netns", other)
    for host, name, address in ((one, names[0], one_ip), (other, names[1], other_ip)):
        _ip("-n", host, "address", "add", f"{address}/24", "dev", name)
        _ip("-n", host, "link", "set", name, "up")
        _ip("-n", host, "link", "set", "lo", "up")


def _ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"no right to connect network namespaces: {done.stderr.strip()}")
