"""Receiver of poses from ROS 2: Zenoh without ROS. It needs the package eclipse-zenoh."""

import json
import queue
import struct
from math import atan2

import zenoh
from positions import Pose

TYPE = "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"
LITTLE_ENDIAN = b"\0\1\0\0"


class Ros2Positions:
    """The newest pose of a robot from its topic ``/<robot>/pose`` of domain 0; ``count`` is that of all."""

    def __init__(self, address, robot):
        self.count, self.pose, self.samples = 0, None, queue.SimpleQueue()
        config = zenoh.Config()
        settings = {"mode": "client", "connect/endpoints": ["tcp/{}:{}".format(*address)]}
        settings |= {"scouting/multicast/enabled": False, "scouting/gossip/enabled": False}
        for name, value in settings.items():
            config.insert_json5(name, json.dumps(value))
        self.session = zenoh.open(config)
        self.subscriber = self.session.declare_subscriber(f"0/{robot}/pose/{TYPE}/*", self.samples.put)
        # The router answers after it has read the subscription: from now on, no pose is missed.
        if not list(self.session.liveliness().get(f"@ros2_lv/0/*/*/*/MP/*/*/*/%{robot}%pose/**")):
            raise SystemExit(f"no node publishes /{robot}/pose")

    def close(self):
        self.session.close()  # else the end of the program can hang

    def receive(self, wait_s, now_s):
        """Read what has arrived; wait for the first message at most this long."""
        try:
            while True:
                sample = self.samples.get(timeout=wait_s)
                wait_s = 0.0
                self.count += 1
                self.read(sample.payload.to_bytes(), now_s)
        except queue.Empty:
            return

    def read(self, data, now_s):
        """Decode PoseWithCovarianceStamped: the stamp, the name of the frame, position and rotation (CDR)."""
        try:
            seconds, nanoseconds, length = struct.unpack_from("<iII", data, 4)
            start = 16 + length
            # Numbers of 8 bytes begin at a multiple of 8, after the 4 bytes of the header.
            x_m, y_m, _, _, _, z, w = struct.unpack_from("<7d", data, start + (4 - start) % 8)
        except struct.error:
            return
        time_ns = seconds * 10**9 + nanoseconds
        if data[:4] == LITTLE_ENDIAN and (self.pose is None or time_ns >= self.pose.time_ns):
            self.pose = Pose(time_ns / 1e9, now_s, x_m, y_m, 2 * atan2(z, w), time_ns)
