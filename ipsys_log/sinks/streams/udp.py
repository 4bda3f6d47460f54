"""UDP stream: one JSON object in each datagram, optionally signed (HMAC-SHA256)."""

import hashlib
import hmac
import json
import socket
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Message, Tracks
from ipsys_log.sinks.sink import DropReport, Warn
from ipsys_log.sinks.streams.addresses import find_destination, is_loopback, local_address, open_datagrams
from ipsys_log.sinks.streams.poses import NewSession, PoseSource, StreamContext, StreamPose

# The version of the datagram: a receiver drops other versions.
FORMAT = 1
_FEWEST_KEY_BYTES, _MOST_KEY_BYTES = 16, 4096
_DECIMALS = 6  # of m, rad and s


def encode_pose(pose: StreamPose, key: bytes | None = None) -> bytes:
    """Return the datagram of a pose: a JSON object, and with a key a newline and the signature in hex.

    Fields without a value are left out. docs/streams.md lists the fields.
    """
    track, velocity = pose.track, pose.velocity
    fields: dict[str, Any] = {
        "ipsys": FORMAT,
        "session": pose.session,
        "seq": pose.sequence,
        "robot": track.robot,
        "id": track.id,
        "time_ns": pose.time_ns,
        "age_s": round(pose.age_s, _DECIMALS),
        "stale": pose.is_stale,
        "late": pose.is_late,
        "outside": pose.is_outside,
        "x_m": round(track.x_m, _DECIMALS),
        "y_m": round(track.y_m, _DECIMALS),
        "z_m": round(track.z_m, _DECIMALS),
        "heading_rad": _rounded(track.heading_rad),
        "quaternion": None if track.rotation_rad is None else _rounded_all(pose.quaternion),
    }
    if velocity is not None:
        fields |= {"vx_m_s": _rounded(velocity.x_m_s), "vy_m_s": _rounded(velocity.y_m_s)}
        fields |= {"vz_m_s": _rounded(velocity.z_m_s), "yaw_rad_s": _rounded(velocity.yaw_rad_s)}
        fields |= {"velocity_covariance_m2_s2": _shortened(velocity.covariance_m2_s2)}
        fields |= {"yaw_sigma_rad_s": _rounded(velocity.yaw_sigma_rad_s)}
        fields |= {"angular_rad_s": _rounded_all(velocity.angular_rad_s)}
    fields |= {"covariance_m2": _shortened(pose.covariance_m2)}
    fields |= {"heading_sigma_rad": _rounded(pose.heading_sigma_rad)}
    fields |= {"pose_covariance": _shortened(pose.covariance)}
    if track.cameras:
        fields["cameras"] = list(track.cameras)
    present = {name: value for name, value in fields.items() if value is not None}
    body = json.dumps(present, separators=(",", ":"), allow_nan=False).encode()
    if key is None:
        return body
    return body + b"\n" + hmac.new(key, body, hashlib.sha256).hexdigest().encode()


def _shortened(covariance: Array | None) -> list[float] | None:
    """Return the numbers of a covariance with 4 digits, row by row."""
    return None if covariance is None else [float(f"{value:.4g}") for value in covariance.ravel().tolist()]


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, _DECIMALS)


def _rounded_all(values: Iterable[float] | None) -> list[float] | None:
    return None if values is None else [round(float(value), _DECIMALS) for value in values]


def read_key(path: Path) -> bytes:
    """Read the key of signatures from a file, without spaces and newlines at its ends."""
    try:
        with path.open("rb") as file:
            key = file.read(_MOST_KEY_BYTES + 1).strip()
    except FileNotFoundError as error:
        raise IpsysError(
            f"--key {path}: does not exist; to make it: openssl rand -hex 32 > {path}"
        ) from error
    except OSError as error:
        raise IpsysError(f"--key {path}: cannot be read: {error.strerror}") from error
    if not _FEWEST_KEY_BYTES <= len(key) <= _MOST_KEY_BYTES:
        raise IpsysError(
            f"--key {path}: has {len(key)} bytes; write {_FEWEST_KEY_BYTES} to {_MOST_KEY_BYTES}, for "
            f"example with: openssl rand -hex 32 > {path}"
        )
    return key


class UdpStream:
    """A :class:`~ipsys_log.sinks.sink.InlineSink` that sends each pose in a datagram. It never receives.

    Datagrams for which the system has no room are dropped and counted.

    Parameters
    ----------
    target : the destination, ``HOST:PORT``; datagrams to a multicast group pass no router (TTL 1).
    host : the address of this machine to send from; None: datagrams stay on this machine.
    poses : gives the poses of a message.
    key : signs the datagrams.

    Raises
    ------
    IpsysError
        The destination is not known or cannot be reached, or is another machine and there is no host.
    """

    payloads: tuple[type, ...] = (Tracks, NewSession)

    def __init__(
        self, target: str, host: str | None, poses: PoseSource, warn: Warn, key: bytes | None = None
    ) -> None:
        self._destination = find_destination(target, "--udp")
        self.name = f"UDP {target}"
        self._poses, self._key = poses, key
        self.drops = DropReport(self.name, warn)
        self._local = local_address(self._destination, host, "--udp")
        self._socket = open_datagrams(self._destination, self._local, "--udp")
        # No program reads this socket: the smallest buffer for datagrams that others send to it.
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 0)
        self._socket.setblocking(False)

    def describe(self) -> str:
        """Return one line about the receivers of the positions."""
        signed = "" if self._key is None else ", signed"
        if is_loopback(self._local):
            return f"{self.name}{signed}: only this machine"
        if self._destination.is_multicast:
            return f"{self.name}{signed}: every computer of this network can read the positions"
        return f"{self.name}{signed}: sent into the network from {self._local}, not encrypted"

    def send(self, message: Message) -> None:
        """Send the poses of a message."""
        for pose in self._poses.read(message):
            self._send(encode_pose(pose, self._key))

    def close(self) -> None:
        """Close the socket."""
        self.drops.finish()
        self._socket.close()

    def _send(self, datagram: bytes) -> None:
        try:
            self._socket.sendto(datagram, self._destination.address)
        except BlockingIOError:
            self.drops.add("the system has no room for more datagrams")
        except OSError as error:
            self.drops.add(str(error.strerror))


def open_all(context: StreamContext) -> Iterator[UdpStream]:
    """Yield a stream for each destination."""
    settings = context.settings
    key = None if settings.key is None else read_key(settings.key)
    for target in dict.fromkeys(settings.udp):
        yield UdpStream(target, settings.host, context.poses(), context.warn, key)
