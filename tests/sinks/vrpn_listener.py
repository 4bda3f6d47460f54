"""A program with the VRPN client of the package motioncapture: it writes the poses that it receives.

It runs as a process of its own: the client of VRPN prints to the terminal, and may wait without an end.
"""

import json
import sys

import motioncapture


def main(host: str, count: int) -> None:
    client = motioncapture.connect("vrpn", {"hostname": host})
    sent = 0
    while sent < count:
        client.waitForNextFrame()
        for name, body in client.rigidBodies.items():
            turn = body.rotation
            pose = [*body.position.tolist(), turn.x, turn.y, turn.z, turn.w]
            sys.stdout.write(f"POSE {json.dumps([name, pose])}\n")
            sys.stdout.flush()
            sent += 1


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
