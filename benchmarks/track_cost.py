"""Time of the stage that tracks: one message of one camera with the positions of 20 robots, in one thread.

    python benchmarks/track_cost.py

Three cameras are 11 ms out of step. Beside the usual messages, some arrive 0.5 s late: all sightings of the
history of each robot are then filtered again. Times are processor times of a message, with a calibration of
a simulated lab. The same work is repeated in each round.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from results import Report, command
from rounds import Row
from threadpoolctl import threadpool_limits
from track_drives import CALIBRATIONS, Condition, calibrate

from ipsys_log.capture.simulation.lab import EPOCH_NS, build_rig
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import Message, Model, Position, Positions, RigMarker
from ipsys_log.stages.fuse import Fuse
from ipsys_log.units import NS_PER_S

__all__ = ["measure"]

Array = NDArray[np.float64]

_SEED = 3900
_ROBOTS, _STEP_NS, _LATE_NS = 20, 11_000_000, 490_000_000
_WARM_UP, _EVERY = 60, 20
# With three late messages after the first ones.
_SMOKE = 130
_NOISE_M = 0.0003
_MS = 1000.0


def measure(options: argparse.Namespace) -> Report:
    """Track 20 robots, and time each message."""
    report = Report("track_cost")
    count = _SMOKE if options.smoke else options.messages
    model = calibrate(Condition("cost", 0.5), options.calibration, _SEED)
    usual, late = [], []
    with threadpool_limits(1):
        for _ in range(options.rounds):
            in_order, delayed = _times(model, count)
            usual.append(in_order)
            late.append(delayed)
    report.details = {"usual_ms": [one.tolist() for one in usual], "late_ms": [one.tolist() for one in late]}
    medians, tails = ([float(np.percentile(one, share)) for one in usual] for share in (50, 99))
    report.rows.append(Row("20 robots: median", tuple(medians), "ms", ("<=", 0.5)))
    report.rows.append(Row("20 robots: 99 %", tuple(tails), "ms", ("<=", 1.0)))
    report.rows.append(
        Row("0.49 s late: median", tuple(float(np.median(one)) for one in late), "ms", ("<=", 20.0))
    )
    ratios = [float(np.median(two) / np.median(one)) for one, two in zip(usual, late, strict=True)]
    report.rows.append(Row("0.49 s late / in order", tuple(ratios)))
    return report


def _times(model: Model, count: int) -> tuple[Array, Array]:
    """Return the times of messages in order, and of late messages, in ms."""
    step = Fuse("cost", model)
    times: dict[bool, list[float]] = {False: [], True: []}
    for number, (message, is_late) in enumerate(_messages(model, count)):
        begin = time.process_time()
        for _ in step(message):
            pass
        if number > _WARM_UP:
            times[is_late].append(_MS * (time.process_time() - begin))
    return np.array(times[False]), np.array(times[True])


def _messages(model: Model, count: int) -> Iterator[tuple[Message, bool]]:
    """Yield the rig, and messages of 20 robots on circles; every 20th message is late."""
    rng, rig = np.random.default_rng(_SEED), build_rig(LabSettings())
    markers = tuple(RigMarker(n, robot=f"robot_{n}") for n in range(_ROBOTS))
    yield Message("/rig", EPOCH_NS, EPOCH_NS, replace(rig, markers=markers)), False
    cameras = [camera.camera for camera in model.cameras]
    for number in range(1, count):
        is_late = number % _EVERY == 0
        time_ns = EPOCH_NS + number * _STEP_NS - _LATE_NS * is_late
        angles = 0.5 * (time_ns - EPOCH_NS) / NS_PER_S + np.arange(_ROBOTS)
        centres_m = 1.5 + 0.4 * np.stack([np.arange(_ROBOTS) % 5, np.arange(_ROBOTS) // 5], axis=1)
        points_m = centres_m + np.stack([np.cos(angles), np.sin(angles)], axis=1)
        points_m += _NOISE_M * rng.normal(size=points_m.shape)
        headings = ((angles + np.pi / 2 + np.pi) % (2 * np.pi) - np.pi).tolist()
        positions = tuple(
            Position(n, x_m, y_m, 0.1, headings[n], 4e-6 * np.eye(3), True)
            for n, (x_m, y_m) in enumerate(points_m.tolist())
        )
        camera = cameras[number % len(cameras)]
        log_time_ns = EPOCH_NS + number * _STEP_NS
        yield Message("", log_time_ns, time_ns, Positions(time_ns, positions), camera), is_late


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--messages", type=int, default=1500, help="messages of a round")
    parser.add_argument("--calibration", default="rayplane", choices=list(CALIBRATIONS))


if __name__ == "__main__":
    command("track_cost")
