"""Logs with a rig and smooth tracks of two robots, and files of another system with the same paths."""

import json
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ipsys_log.engine.output import write_log
from ipsys_log.messages import ChannelWritten, Message, RigMarker, Run, Track, Tracks
from ipsys_log.messages.channels import RECORD, RIG_TOPIC, TRACKS
from ipsys_log.units import NS_PER_S
from tests.labs import RIG

Array = NDArray[np.float64]
Path3 = Callable[[Array], Array]

START_NS = 1_700_000_000_000_000_001
ROBOTS = {"ada": 0, "bob": 7}
LAB = replace(RIG, markers=tuple(RigMarker(number, robot=name) for name, number in ROBOTS.items()))


def path_of(seed: int) -> Path3:
    """Return a smooth random path over the floor, as a function of times (n,) in s to points (n, 3)."""
    rng = np.random.default_rng(seed)
    rates, phases = rng.uniform(0.1, 0.7, (2, 4)), rng.uniform(0, 2 * np.pi, (2, 4))

    def points_m(times_s: Array) -> Array:
        waves = np.sin(times_s[:, None, None] * rates + phases) * [1.0, 0.7, 0.3, 0.2]
        return np.column_stack([2.4 + waves.sum(axis=2), np.full(len(times_s), 0.15)])

    return points_m


def instants_ns(seconds: float, rate_hz: float = 30.0) -> NDArray[np.int64]:
    return START_NS + (np.arange(round(seconds * rate_hz)) * NS_PER_S / rate_hz).astype(np.int64)


def tracked(
    times_ns: NDArray[np.int64],
    points_m: dict[str, Array],
    with_record: bool = True,
    with_headings: bool = True,
    is_tilted: bool = False,
) -> Iterator[Message]:
    """Yield the messages of a log: the rig, the tracks of the run ``poly``, and its record."""
    yield Message(RIG_TOPIC, START_NS - 1, START_NS - 1, LAB)
    topic = TRACKS.topic_of("poly")
    for n, time_ns in enumerate(times_ns.tolist()):
        tracks = []
        for robot, rows in points_m.items():
            ahead = rows[min(n + 1, len(rows) - 1)] - rows[max(n - 1, 0)]
            heading_rad = float(np.arctan2(ahead[1], ahead[0])) if with_headings else None
            x_m, y_m, z_m = rows[n].tolist()
            track = Track(robot, ROBOTS[robot], x_m, y_m, z_m, heading_rad)
            if is_tilted and heading_rad is not None:
                vector_rad = tilted(np.array([heading_rad]), times_ns[[n]])[0].as_rotvec()
                track = replace(track, rotation_rad=vector_rad)
            tracks.append(track)
        yield Message(topic, time_ns, time_ns, Tracks(time_ns, tuple(tracks)))
    if with_record:
        written = (ChannelWritten(topic, len(times_ns)),)
        record = Run(time_ns, "poly", "fuse", outputs=written, number=1)
        yield Message(RECORD.topic_of("poly"), time_ns, time_ns, record)


def tilted(headings_rad: Array, times_ns: NDArray[np.int64]) -> Rotation:
    """Return rotations with these headings of bodies that sway by up to 35 degrees."""
    sway_rad = 0.6 * np.sin(np.outer((times_ns - START_NS) / NS_PER_S, [1.7, 1.3]))
    return Rotation.from_euler("ZYX", np.column_stack([headings_rad, sway_rad]))


def write_lab(
    path: Path,
    seconds: float = 30.0,
    noise_m: float = 0.0,
    robots: tuple[str, ...] = ("ada", "bob"),
    is_tilted: bool = False,
) -> Path:
    """Write a log of two robots that drive, with normal errors of their tracks."""
    rng, times_ns = np.random.default_rng(0), instants_ns(seconds)
    times_s = (times_ns - START_NS) / NS_PER_S
    points_m = {
        robot: path_of(ROBOTS[robot])(times_s) + rng.normal(0, noise_m, (len(times_ns), 3)) * [1, 1, 0]
        for robot in robots
    }
    write_log(path, tracked(times_ns, points_m, is_tilted=is_tilted))
    return path


def evo_rmse_m(truth: Path, estimate: Path, *options: str) -> float:
    """Return the RMSE of the absolute trajectory error of TUM files, by evo."""
    folder = truth.parent
    subprocess.run(
        [
            *map(str, (Path(sys.executable).with_name("evo_ape"), "tum", truth, estimate, *options)),
            *("--no_warnings", "--save_results", str(folder / "ape.zip")),
        ],
        check=True,
        capture_output=True,
        env={"HOME": str(folder), "PATH": "/usr/bin:/bin"},
    )
    with zipfile.ZipFile(folder / "ape.zip") as archive:
        return float(json.loads(archive.read("stats.json"))["rmse"])


class OtherSystem:
    """The clock and the coordinates of another system: ``turn_rad`` about z, or (3,); ``shift_m`` (3,)."""

    def __init__(self, offset_ns: int, turn_rad: float | Array, shift_m: tuple[float, float, float]) -> None:
        self.offset_ns = offset_ns
        vector = turn_rad if isinstance(turn_rad, np.ndarray) else np.array([0.0, 0.0, turn_rad])
        self.lab_from_own = Rotation.from_rotvec(vector)
        self.shift_m = np.array(shift_m)

    def times_ns(self, lab_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        return lab_ns - self.offset_ns

    def points_m(self, lab_m: Array) -> Array:
        return np.asarray(self.lab_from_own.inv().apply(lab_m - self.shift_m))
