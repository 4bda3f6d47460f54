"""Publish the poses of a UDP stream of ipsys as nav_msgs/Odometry, with rclpy and any RMW.

Save the receiver of docs/streams.md as receive.py beside this file.
"""

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.time import Time


def publish(node, poses):
    """Publish each good pose of a receiver as /<robot>/odom, in the frame map."""
    publishers = {}
    for pose in poses:
        if pose is None or pose["stale"] or pose.get("outside") or "heading_rad" not in pose:
            continue
        message, half = Odometry(), pose["heading_rad"] / 2
        message.header.stamp = Time(nanoseconds=pose["time_ns"]).to_msg()
        message.header.frame_id, message.child_frame_id = "map", pose["robot"]
        at, turn, speed = (
            message.pose.pose.position,
            message.pose.pose.orientation,
            message.twist.twist.linear,
        )
        at.x, at.y, at.z = pose["x_m"], pose["y_m"], pose["z_m"]
        turn.x, turn.y, turn.z, turn.w = pose.get("quaternion", (0.0, 0.0, np.sin(half), np.cos(half)))
        covariance = np.eye(6) * 1e6  # unknown
        if "covariance_m2" in pose:
            covariance[:3, :3] = np.reshape(pose["covariance_m2"], (3, 3))
        message.pose.covariance = pose.get("pose_covariance", covariance.ravel())
        # The velocity is along the axes of the robot.
        back, move = -np.array([turn.x, turn.y, turn.z]), [pose.get(f"v{axis}_m_s", 0.0) for axis in "xyz"]
        speed.x, speed.y, speed.z = move + 2 * np.cross(back, np.cross(back, move) + turn.w * np.array(move))
        message.twist.covariance = (np.eye(6) * 1e6).ravel()
        if pose["robot"] not in publishers:
            publishers[pose["robot"]] = node.create_publisher(Odometry, f"/{pose['robot']}/odom", 10)
        publishers[pose["robot"]].publish(message)


if __name__ == "__main__":
    import socket

    import rclpy
    from receive import receive

    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 9870))
    rclpy.init()
    publish(rclpy.create_node("ipsys"), receive(sock))
