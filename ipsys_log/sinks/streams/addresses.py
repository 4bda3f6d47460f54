"""Addresses of streams: destinations and local addresses, loopback unless the user names a host."""

import errno
import ipaddress
import socket
from collections.abc import Collection
from dataclasses import dataclass

from ipsys_log.errors import IpsysError

LOOPBACK = "127.0.0.1"
_LOOPBACK_6 = "::1"
_LARGEST_PORT = 65535


@dataclass(frozen=True, slots=True)
class Destination:
    """The receiver of datagrams: a name for messages, the family of its address, and the address."""

    name: str
    family: socket.AddressFamily
    address: tuple[str, int]

    @property
    def is_multicast(self) -> bool:
        return ipaddress.ip_address(self.address[0]).is_multicast

    @property
    def is_loopback(self) -> bool:
        return is_loopback(self.address[0])


def is_loopback(address: str) -> bool:
    """Return whether only this machine can reach an address."""
    return ipaddress.ip_address(address).is_loopback


def is_own_host(host: str, names: Collection[str]) -> bool:
    """Return whether the header ``Host`` of a request is an IP address or one of the names of this machine.

    A page of a foreign site may name a host of its own that leads to this machine (DNS rebinding).

    Examples
    --------
    >>> is_own_host("[::1]:8000", []), is_own_host("evil.example:8000", ["localhost"])
    (True, False)
    """
    name = host.rpartition(":")[0] if ":" in host and not host.endswith("]") else host
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return name.lower() in names
    return True


def listen(host: str, port: int, option: str, backlog: int) -> socket.socket:
    """Return a listening socket of TCP.

    Raises
    ------
    IpsysError
        The port is in use or not allowed, or the host is not this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=backlog)
    except OSError as error:
        raise refuse_bind(error, host, port, option) from error


def find_destination(text: str, option: str) -> Destination:
    """Return the destination ``HOST:PORT``, ``[IPV6]:PORT`` or ``PORT`` (of this machine).

    Parameters
    ----------
    option : the source of the text, for the message: ``--udp``.

    Examples
    --------
    >>> find_destination("9870", "--udp").address
    ('127.0.0.1', 9870)
    """
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") or LOOPBACK
    if not (port.isascii() and port.isdigit() and 0 < int(port) <= _LARGEST_PORT):
        raise IpsysError(f"{option} {text}: is not an address; write HOST:PORT, such as 192.168.1.20:9870")
    try:
        family, *_, address = socket.getaddrinfo(host, int(port), type=socket.SOCK_DGRAM)[0]
    except (socket.gaierror, UnicodeError) as error:
        raise IpsysError(f"{option} {text}: the host {host!r} is not known; write its IP address") from error
    return Destination(text, family, (str(address[0]), int(port)))


def local_address(destination: Destination, host: str | None, option: str) -> str:
    """Return the address of this machine from which datagrams to a destination are sent.

    ``host`` is the address that the user named; None: datagrams stay on this machine.
    """
    if destination.is_loopback:
        return _LOOPBACK_6 if destination.family == socket.AF_INET6 else LOOPBACK
    if host is None and destination.is_multicast and destination.family == socket.AF_INET:
        return LOOPBACK
    if host is None:
        raise IpsysError(
            f"{option} {destination.name}: is another machine; to send positions into the network, "
            "add --host ADDRESS (an address of this machine, or 0.0.0.0)"
        )
    return host


def refuse_bind(error: OSError, host: str, port: int, option: str) -> IpsysError:
    """Return the error for an address that a stream cannot use."""
    if error.errno == errno.EADDRINUSE:
        return IpsysError(
            f"{option}: port {port} is in use, perhaps by another ipsys; end that program, or give another "
            "port"
        )
    if error.errno == errno.EACCES:
        return IpsysError(f"{option}: port {port} is not allowed; give one from 1024 to {_LARGEST_PORT}")
    return IpsysError(f"--host {host}: is not an address of this machine; use 0.0.0.0 for all its addresses")


def open_datagrams(destination: Destination, local: str, option: str) -> socket.socket:
    """Return a socket that sends datagrams to a destination; those to a group pass no router (TTL 1)."""
    sending = socket.socket(destination.family, socket.SOCK_DGRAM)
    try:
        if destination.is_multicast:
            _set_multicast(sending, destination, local, option)
        try:
            sending.bind((local, 0))
        except OSError as error:
            raise refuse_bind(error, local, 0, option) from error
        if not destination.is_multicast:
            _check_route(destination, local, option)
    except BaseException:
        sending.close()
        raise
    return sending


def _set_multicast(sending: socket.socket, destination: Destination, local: str, option: str) -> None:
    if destination.family != socket.AF_INET:
        raise IpsysError(f"{option} {destination.name}: give a group of IPv4, such as 239.255.0.1:9870")
    sending.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
    if local != "0.0.0.0":
        try:
            sending.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(local))
        except OSError as error:
            raise refuse_bind(error, local, 0, option) from error


def _check_route(destination: Destination, local: str, option: str) -> None:
    """Check that a route leads to a destination; to connect a socket of UDP sends nothing."""
    with socket.socket(destination.family, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((local, 0))
            probe.connect(destination.address)
        except OSError as error:
            raise IpsysError(
                f"{option} {destination.name}: cannot be reached from {local} ({error.strerror}); correct "
                "the address, or --host"
            ) from error
