"""Addresses of streams: destinations and local addresses, loopback unless the user names a host."""

from __future__ import annotations

import errno
import ipaddress
import socket
from dataclasses import dataclass

from ipsys_log.errors import IpsysError

__all__ = ["LOOPBACK", "Destination", "find_destination", "is_loopback", "local_address", "refuse_bind"]

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


def find_destination(text: str, option: str) -> Destination:
    """Return the destination ``HOST:PORT``, ``[IPV6]:PORT`` or ``PORT`` (of this machine).

    Parameters
    ----------
    option : the source of the text, for the message: ``--udp``.

    Raises
    ------
    IpsysError
        The text has another form, or the name of the host is not known.

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

    Parameters
    ----------
    host : the address that the user named; None: datagrams stay on this machine.

    Raises
    ------
    IpsysError
        The destination is another machine, and the user named no host.
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
