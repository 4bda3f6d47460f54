"""Faults of commands, files and messages to vehicles: see ``contradictions.py``."""

from __future__ import annotations

import shutil
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from fault_trials import Fault, Outcome, Trial, cases_folder
from pymavlink.dialects.v20 import common

from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Message, Rig, RigMarker, Track, Tracks
from ipsys_log.messages.channels import SMOOTHED_TRACKS
from ipsys_log.units import NS_PER_S

if TYPE_CHECKING:
    from tests.sinks.autopilots import Reading

__all__ = ["FAULTS"]

_START_NS = 1_700_000_000 * NS_PER_S
_WAIT_S = 60.0
_ROOT = Path(__file__).resolve().parent.parent
_SAMPLE = _ROOT / "sample_logs/small_lab.mcap"
# Covariance of the tracks that are sent: 3 mm, and 1 degree.
_TRACK = Track(
    "ada", 0, 1.0, 2.0, 0.1, 0.4, np.eye(3) * 9e-6, ("red",), True,
    velocity_m_s=np.array([0.2, 0.0, 0.0]), velocity_covariance_m2_s2=np.eye(3) * 1e-4,
    heading_sigma_rad=0.017, turn_rate_rad_s=0.0, turn_rate_sigma_rad_s=0.01,
)  # fmt: skip


def _send(trial: Trial, kind: str) -> Outcome:
    """Play a track to an autopilot; read the message by the rules of PX4 and ArduPilot."""
    from tests.sinks.autopilots import ardupilot, px4

    rows = [
        Message("/runs/poly/tracks", time_ns, time_ns, Tracks(time_ns, (_TRACK,)))
        for time_ns in range(_START_NS, _START_NS + NS_PER_S, NS_PER_S // 25)
    ]
    rig = Rig("lab", "DICT_4X4_100", 0.2, (RigMarker(0, robot="ada"),))
    write_log(trial.folder / "lab.mcap", [Message("/rig", _START_NS, _START_NS, rig), *rows])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(_WAIT_S)
        address = f"ada=127.0.0.1:{autopilot.getsockname()[1]}"
        suffix = "/vision" if kind == "VISION_POSITION_ESTIMATE" else ""
        trial.ipsys("stream", "lab.mcap", "--mavlink", address + suffix, "--topics", "/runs/poly/tracks")
        message = _receive(autopilot, kind)
    readings = {"PX4": px4(message), "ArduPilot": ardupilot(message)}
    return Outcome(
        all(_is_used(reading) for reading in readings.values()),
        figure="; ".join(f"{name}: {_describe(reading)}" for name, reading in readings.items()),
    )


def _receive(autopilot: socket.socket, kind: str) -> Any:
    parser = common.MAVLink(None)
    while True:
        for message in parser.parse_buffer(autopilot.recv(2048)) or []:
            if message.get_type() == kind:
                return message


def _is_used(reading: Reading) -> bool:
    return reading.position_m is not None and reading.yaw_rad is not None and reading.internal_errors == 0


def _describe(reading: Reading) -> str:
    if reading.position_m is None:
        return "no position"
    yaw = "yaw" if reading.yaw_rad is not None and reading.yaw_sigma_rad is not None else "no stated yaw"
    return f"position and {yaw}, {reading.internal_errors} internal errors"


def _odometry(trial: Trial) -> Outcome:
    return _send(trial, "ODOMETRY")


def _vision(trial: Trial) -> Outcome:
    return _send(trial, "VISION_POSITION_ESTIMATE")


def _smooth(trial: Trial) -> Outcome:
    """Smooth after a replay with a model; the log already has a run of the default model."""
    log = Path(shutil.copy(_SAMPLE, trial.folder))
    trial.ipsys("replay", log.name, "--model", "rigid")
    trial.ipsys("smooth", log.name)
    with Session([log]) as session:
        runs = [name for name in session.run_names() if session.topics(SMOOTHED_TRACKS, name)]
    return Outcome(runs == ["rigid"], figure=f"smoothed: {', '.join(runs)}, of a replay with rigid")


def _plots(trial: Trial) -> Outcome:
    """Draw the figures of a log with ground truth."""
    log = Path(shutil.copy(_SAMPLE, trial.folder))
    answer = trial.ipsys("replay", log.name, "--plot", "figures")
    number = len(list((trial.folder / "figures").glob("*")))
    lines = answer.strip().splitlines()
    return Outcome("Traceback" not in answer and number > 0, figure=f"{number} files; {lines[-1][:60]}")


def _repaired(trial: Trial) -> Outcome:
    """Repair a log whose schemas were lost, and read it."""
    log = trial.folder / "log.mcap"
    log.write_bytes((cases_folder() / "damage/appended_1_3196.mcap").read_bytes())
    trial.ipsys("repair", log.name)
    answer = trial.ipsys("info", log.name)
    return Outcome("cannot be read" not in answer, figure=f"info: {answer.strip().splitlines()[0][:60]}")


FAULTS: Sequence[Fault] = (
    Fault("ODOMETRY for PX4 and ArduPilot", _odometry),
    Fault("VISION_POSITION_ESTIMATE for both autopilots", _vision),
    Fault("smooth without --model after a replay", _smooth),
    Fault("replay --plot of a log with ground truth", _plots),
    Fault("repaired log with a lost schema is read", _repaired),
)
