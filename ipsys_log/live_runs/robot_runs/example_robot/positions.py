"""Receivers of positions: UDP (JSON) and VRPN, with the standard library only."""

import json
import select
import socket
import struct
from math import atan2
from typing import NamedTuple


class Pose(NamedTuple):
    """A received pose: capture time, arrival by the robot's own clock, position, and heading."""

    time_s: float
    arrival_s: float
    x_m: float
    y_m: float
    heading_rad: float
    time_ns: int


class UdpPositions:
    """The newest pose of a robot from datagrams; ``count`` is the number of all datagrams so far."""

    def __init__(self, address, robot):
        self.robot, self.count, self.newest, self.pose = robot, 0, (0, 0), None
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(address)

    def close(self):
        self.socket.close()

    def receive(self, wait_s, now_s):
        """Read what has arrived; wait for the first datagram at most this long."""
        while select.select([self.socket], [], [], wait_s)[0]:
            wait_s = 0.0
            self.count += 1
            self.read(self.socket.recv(2048), now_s)

    def read(self, datagram, now_s):
        try:
            fields = json.loads(datagram.partition(b"\n")[0])
            number = int(fields["session"]), int(fields["seq"])
            if fields["ipsys"] != 1 or fields["robot"] != self.robot or number <= self.newest:
                return  # of another robot, old or repeated
            pose = Pose(
                fields["time_ns"] / 1e9, now_s, fields["x_m"], fields["y_m"], fields["heading_rad"],
                fields["time_ns"],
            )  # fmt: skip
        except (ArithmeticError, LookupError, RecursionError, TypeError, ValueError):
            return  # foreign, or without a heading
        self.newest = number
        if not fields["stale"]:
            self.pose = pose


class VrpnPositions:
    """The same from a VRPN server (07.38, TCP). Each message has a header of six numbers."""

    GREETING = b"vrpn: ver. 07.38  0".ljust(24, b"\0")
    HEADER, REPORT = struct.Struct(">IIIiiI"), struct.Struct(">ii3d4d")

    def __init__(self, address, robot):
        self.robot, self.count, self.pose = robot.encode(), 0, None
        self.senders, self.types, self.data = {}, {}, b""
        self.socket = socket.create_connection(address)
        self.socket.sendall(self.GREETING)
        while len(self.data) < len(self.GREETING):
            self.data += self.more()
        self.data = self.data[len(self.GREETING) :]
        self.parse(0.0)
        while b"vrpn_Tracker Pos_Quat" not in self.types.values():  # then the server knows this client
            self.receive(1.0, 0.0)

    def close(self):
        self.socket.close()

    def more(self):
        data = self.socket.recv(65536)
        if not data:
            raise SystemExit("the VRPN server has closed the connection")
        return data

    def receive(self, wait_s, now_s):
        """Read what has arrived; wait for the first bytes at most this long."""
        while select.select([self.socket], [], [], wait_s)[0]:
            wait_s = 0.0
            self.data += self.more()
            self.parse(now_s)

    def parse(self, now_s):
        while len(self.data) >= self.HEADER.size:
            length, seconds, micros, sender, kind, _ = self.HEADER.unpack_from(self.data)
            padded = length + -length % 8
            if len(self.data) < padded:
                break
            time_ns = seconds * 10**9 + micros * 1000
            self.read(self.data[self.HEADER.size : length], time_ns, sender, kind, now_s)
            self.data = self.data[padded:]

    def read(self, content, time_ns, sender, kind, now_s):
        if kind in (-1, -2):  # the name of a robot, or of a type of messages
            (self.senders if kind == -1 else self.types)[sender] = content[4:].partition(b"\0")[0]
        elif self.types.get(kind) == b"vrpn_Tracker Pos_Quat" and self.senders.get(sender) == self.robot:
            self.count += 1
            _, _, x_m, y_m, _, _, _, z, w = self.REPORT.unpack(content)
            if self.pose is None or time_ns >= self.pose.time_ns:
                self.pose = Pose(time_ns / 1e9, now_s, x_m, y_m, 2 * atan2(z, w), time_ns)
