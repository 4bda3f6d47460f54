"""Send the poses of a UDP stream of ipsys to the estimator of a Crazyflie, with cflib (Bitcraze).

Save the receiver of docs/streams.md as receive.py beside this file. In the rig, the body of the Crazyflie has
``level = false``. Its parameter ``stabilizer.estimator`` must be 2.
"""


def follow(cf, poses):
    """Send each good pose of a receiver to the estimator of a Crazyflie."""
    for pose in poses:
        if pose is None or pose["stale"] or pose.get("outside") or "quaternion" not in pose:
            continue  # without poses, the estimator of the Crazyflie soon drifts: land
        cf.extpos.send_extpose(pose["x_m"], pose["y_m"], pose["z_m"], *pose["quaternion"])


if __name__ == "__main__":
    import socket

    import cflib.crtp
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
    from receive import receive

    cflib.crtp.init_drivers()
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 9870))
    with SyncCrazyflie("radio://0/80/2M/E7E7E7E7E7") as link:
        follow(link.cf, receive(sock))
