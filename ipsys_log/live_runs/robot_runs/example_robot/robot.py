"""A robot with two wheels: it gets positions from a stream, and gives its wheels their speeds.

    python robot.py --robot robot_0 --positions udp://127.0.0.1:9871 --wheels 127.0.0.1:9870 \
        --path "0.5,0.5 0.5,2.5"

``ipsys drive`` starts this program. It knows only its path and the positions that it receives. The wheels are
simulated: they send a tick 20 times a second, with their own clock, and get one command for each tick. In
place of the simulated wheels, your robot has a motor driver and a timer.
"""

import argparse
import json
import socket
from contextlib import suppress

from controller import Controller
from positions import UdpPositions, VrpnPositions

TURN_S = 2.0


def address_of(text):
    host, _, port = text.rpartition("://")[2].rpartition(":")
    return host, int(port)


def parse():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robot", required=True, help="its name in the stream")
    parser.add_argument("--positions", required=True, help="udp://HOST:PORT, vrpn:// or ros2://")
    parser.add_argument("--wheels", required=True, help="HOST:PORT of the simulated wheels")
    parser.add_argument("--path", required=True, help='waypoints in m: "0.5,0.5 0.5,2.5"')
    return parser.parse_args()


def open_positions(text, robot):
    kind = text.partition("://")[0]
    if kind == "ros2":  # needs the package eclipse-zenoh
        from ros2_positions import Ros2Positions

        return Ros2Positions(address_of(text), robot)
    return (VrpnPositions if kind == "vrpn" else UdpPositions)(address_of(text), robot)


def wait_for_tick(wheels, hello):
    """Return the next tick. With lockstep, the simulator may need long for a frame.

    The greeting is sent again and again: it fails after the simulator has ended.
    """
    while True:
        try:
            return json.loads(wheels.recv(2048))
        except TimeoutError:
            wheels.send(hello)


def wait_for_positions(positions, count, now_s, wheels, hello):
    """Read positions. With lockstep, wait until all that were sent have arrived."""
    positions.receive(0.0, now_s)
    while count is not None and positions.count < count:
        before = positions.count
        positions.receive(TURN_S, now_s)
        if positions.count == before:
            wheels.send(hello)


def main():
    options = parse()
    positions = open_positions(options.positions, options.robot)
    controller = Controller([tuple(map(float, point.split(","))) for point in options.path.split()])
    wheels = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wheels.connect(address_of(options.wheels))
    wheels.settimeout(TURN_S)
    hello = json.dumps({"robot": options.robot}).encode()
    wheels.send(hello)
    while True:
        tick = wait_for_tick(wheels, hello)
        if "end" in tick:
            break
        wait_for_positions(positions, tick.get("positions"), tick["time_s"], wheels, hello)
        pose = positions.pose
        (left_m_s, right_m_s), state = controller.step(pose, tick["time_s"])
        command = {"robot": options.robot, "tick": tick["tick"], "left_m_s": left_m_s, "right_m_s": right_m_s}
        command |= {"state": state, "waypoint": controller.number + 1}
        if pose is not None:
            command |= {"x_m": pose.x_m, "y_m": pose.y_m, "time_ns": pose.time_ns}
        wheels.send(json.dumps(command).encode())
    positions.close()


if __name__ == "__main__":
    with suppress(ConnectionRefusedError):  # the simulator has ended
        main()
