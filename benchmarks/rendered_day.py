"""A rendered day of a lab, from images to the history of its cameras: two of them are knocked.

    python benchmarks/rendered_day.py                             # 20 minutes, about an hour
    python benchmarks/rendered_day.py --minutes 3 --knocks 1      # the first knock only, at 30 % of the time

The lab has three cameras, out of step and with rolling shutters, and four robots that drive. The script
renders a calibration (60 points and a drive of one minute), and the day. Then it runs the commands of a user:
calibrate-lab, live (which plays the images in real time), replay, verify, drift. It prints their output, and
the errors of the positions against the simulated paths. The logs stay in ``--folder``.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parent.parent))

from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.joint.payload import find_motion, move_camera, restore_joint
from ipsys_log.capture.simulation.cameras import Camera, FloorView, mount_cameras, prepare_view
from ipsys_log.capture.simulation.drive import Drive, plan_drive
from ipsys_log.capture.simulation.lab import EPOCH_NS, build_rig, moving_marker, simulate, true_tracks
from ipsys_log.capture.simulation.render import encode_jpeg, render
from ipsys_log.capture.simulation.settings import LabSettings, Purpose, random_stream
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    RIG_TOPIC,
    TRUTH_TOPIC,
    CameraPose,
    CompressedImage,
    Message,
    Model,
    RigCamera,
    calibration_topic,
    image_topic,
)
from ipsys_log.messages.channels import CAMERA_POSES, MODEL, POSITIONS, RUN_EVENTS, TRACKS
from ipsys_log.messages.models import MOVED, PARTLY, REPAIRED
from ipsys_log.messages.rig_file import rig_toml
from ipsys_log.units import MM_PER_M, NS_PER_S
from tests.geometric.knocks import Disturbance, disturb

# Points for each camera, seconds of the drive, and sigma of the heights of the points: boxes of known height.
_STATIONS, _CALIBRATION_S, _HEIGHT_SIGMA_M = 33, 60.0, 0.0003
# Frames of the cameras after those of the first, and from the end of an exposure to the arrival of a frame.
_DELAYS_NS, _LATENCY_NS = (0, 11_000_000, 22_000_000), 15_000_000
# Knocks: the number of the camera, the time as a share of the day, turn in degrees, shift in m.
_KNOCKS = ((1, 0.3, 0.3, 0.002), (2, 0.65, 0.15, 0.002))
# Frames that are rendered together.
_TOGETHER = 24


@dataclass(frozen=True)
class Day:
    """A day of the lab: its settings, and the knocks of its cameras by time."""

    settings: LabSettings
    knocks: tuple[Disturbance, ...]

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras before all knocks."""
        return mount_cameras(self.settings, EPOCH_NS)

    @cached_property
    def drive(self) -> Drive:
        """The paths of the robots."""
        return plan_drive(self.settings, self.cameras)

    @property
    def start_ns(self) -> int:
        """The start of the drive."""
        return EPOCH_NS + NS_PER_S

    def knock_of(self, camera: str) -> Disturbance | None:
        """Return the knock of a camera."""
        return next((knock for knock in self.knocks if knock.camera == camera), None)

    def messages(self) -> Iterator[Message]:
        """Yield the messages of the day: rig, intrinsics, ground truth, and images."""
        yield Message(RIG_TOPIC, EPOCH_NS, EPOCH_NS, build_rig(self.settings))
        for number, camera in enumerate(self.cameras):
            log_ns = EPOCH_NS + 1 + number
            yield Message(calibration_topic(camera.name), log_ns, EPOCH_NS, camera.lens, camera.name)
        views = {camera.name: prepare_view(camera, self.settings) for camera in self.cameras}
        moved = {
            knock.camera: prepare_view(disturb(camera, knock), self.settings)
            for camera in self.cameras
            if (knock := self.knock_of(camera.name))
        }
        count = round(self.settings.drive_s * self.settings.rate_hz)
        frames = [
            (self.start_ns + round(index * NS_PER_S / self.settings.rate_hz) + delay_ns, camera.name)
            for index in range(count)
            for camera, delay_ns in zip(self.cameras, _DELAYS_NS, strict=True)
        ]
        robots = build_rig(self.settings).robot_of

        def photograph(index: int) -> Message:
            time_ns, camera = frames[index]
            time_s = (time_ns - self.start_ns) / NS_PER_S
            knock = self.knock_of(camera)
            view = (moved if knock and time_s >= knock.at_s else views)[camera]
            payload = CompressedImage(time_ns, camera, self._draw(view, index, time_s), "jpeg")
            return Message(image_topic(camera), time_ns + _LATENCY_NS, time_ns, payload, camera)

        with ThreadPoolExecutor(2) as pool:
            for first in range(0, len(frames), _TOGETHER):
                for image in pool.map(photograph, range(first, min(first + _TOGETHER, len(frames)))):
                    time_ns = image.publish_time_ns
                    if image.camera == self.cameras[0].name:
                        places = self.drive.poses_at((time_ns - self.start_ns) / NS_PER_S)
                        truth = true_tracks(time_ns, places, robots, self.cameras, self.settings)
                        yield Message(TRUTH_TOPIC, image.log_time_ns - 1, time_ns, truth)
                    yield image

    def _draw(self, view: FloorView, index: int, time_s: float) -> bytes:
        prints = [moving_marker(self.drive, robot, time_s, self.settings) for robot in self.drive.ahead_s]
        rng = random_stream(self.settings.seed, Purpose.FRAME, index)
        return encode_jpeg(render(view, prints, self.settings, rng), self.settings)


def plan_day(seed: int, minutes: float, knocks: int, rate_hz: float) -> Day:
    """Return a day with the first of the knocks, in random directions."""
    settings = LabSettings(
        seed=seed,
        width=640,
        height=360,
        markers=4,
        rate_hz=rate_hz,
        row_time_ns=31_000,
        drive_s=60 * minutes,
        top_tilt_deg=0.3,
    )
    rng = np.random.default_rng(seed)

    planned = []
    for number, share, turn_deg, size_m in _KNOCKS[:knocks]:
        turn, shift = rng.normal(size=(2, 3))
        turn_rad = np.radians(turn_deg) * turn / np.linalg.norm(turn)
        shift_m = size_m * shift / np.linalg.norm(shift)
        at_s = share * settings.drive_s
        planned.append(Disturbance(settings.cameras[number], at_s, tuple(turn_rad), tuple(shift_m)))
    return Day(settings, tuple(planned))


def render_logs(day: Day, folder: Path) -> None:
    """Render the calibration and the day, unless the folder has them; write the rig of the live cameras."""
    calibration = replace(
        day.settings, stations=_STATIONS, drive_s=_CALIBRATION_S, ruler_sigma_m=_HEIGHT_SIGMA_M
    )
    logs: dict[str, Callable[[], Iterator[Message]]] = {
        "calibration": lambda: simulate(calibration),
        "source": day.messages,
    }
    for name, messages in logs.items():
        path, begin_s = folder / f"{name}.mcap", time.monotonic()
        if not path.exists():
            write_log(path.with_suffix(".part.mcap"), messages())
            path.with_suffix(".part.mcap").rename(path)
            print(f"rendered {path.name}: {path.stat().st_size / 1e6:.0f} MB, {_since(begin_s)}", flush=True)
    rig = build_rig(day.settings)
    settings = day.settings
    cameras = tuple(
        RigCamera(
            camera.name,
            source=f"file:{folder / 'source.mcap'}?{camera.name}",
            width=settings.width,
            height=settings.height,
            rate_hz=settings.rate_hz,
            row_time_ns=settings.row_time_ns,
        )
        for camera in rig.cameras
    )
    (folder / "lab.toml").write_text(rig_toml(replace(rig, cameras=cameras)))


def run_commands(folder: Path) -> None:
    """Run the commands of a user, and print their output and their times."""
    used = ("--model-from", "calibration.mcap", "--model", "joint")
    lenses = ("--rig", "lab.toml", "--calibration", "calibration.mcap")
    for arguments in (
        ("calibrate-lab", "calibration.mcap"),
        ("live", *lenses, *used, "-o", "day.mcap", "--self-calibrate"),
        ("replay", "day.mcap", "--self-calibrate"),
        ("replay", "day.mcap", "--run", "uncorrected"),
        ("verify", "day.mcap"),
        ("drift", "day.mcap", "--plot", "history.png"),
    ):
        begin_s = time.monotonic()
        command = [sys.executable, "-m", "ipsys_log", *arguments]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        words = " ".join(arguments)
        print(f"\n$ ipsys {words}   # exit code {done.returncode}, {_since(begin_s)}")
        print(done.stdout + done.stderr, flush=True)


def _since(begin_s: float) -> str:
    return f"{time.monotonic() - begin_s:.0f} s"


@dataclass(frozen=True)
class Clocks:
    """The times of a played log: ``shift_ns`` by camera is the time of its frames after the rendered ones."""

    shift_ns: Mapping[str, int]

    @classmethod
    def of_logs(cls, source: Path, played: Path) -> Clocks:
        """Compare the first frames of the played log with those of the source."""
        shift_ns = {}
        with Session([source]) as old, Session([played]) as new:
            for camera, topic in new.images.items():
                first = next(iter(new.messages([topic])))
                same = (m for m in old.messages([topic]) if m.payload.data == first.payload.data)
                shift_ns[camera] = first.publish_time_ns - next(same).publish_time_ns
        return cls(shift_ns)

    def since_s(self, day: Day, time_ns: int) -> float:
        """Return the time since the start of the drive."""
        return (time_ns - min(self.shift_ns.values()) - day.start_ns) / NS_PER_S


def position_errors(
    day: Day, clocks: Clocks, log: Path, run: str, camera: str | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return times since the start in s, and horizontal errors in mm: of a camera, or of the tracks."""
    times_s, errors_mm = [], []
    with Session([log]) as session:
        topics = session.topics(TRACKS, run) if camera is None else [POSITIONS.topic_of(run, camera)]
        for message in session.messages(topics):
            found = message.payload.tracks if camera is None else message.payload.positions
            for one in found:
                time_ns = message.payload.timestamp + (getattr(one, "time_offset_ns", None) or 0)
                since_s = clocks.since_s(day, time_ns)
                pose = day.drive.pose_at(one.id, since_s)
                times_s.append(since_s)
                errors_mm.append(MM_PER_M * float(np.hypot(one.x_m - pose.x_m, one.y_m - pose.y_m)))
    return np.array(times_s), np.array(errors_mm)


def error_rows(day: Day, clocks: Clocks, log: Path, runs: Sequence[str]) -> Iterator[str]:
    """Yield the mean errors and their 95 % limits, before and after each knock, for the runs of a log."""
    bounds_s = [0.0, *(knock.at_s for knock in day.knocks), day.settings.drive_s]
    spans = [("before", bounds_s[0], bounds_s[1])]
    for knock, end_s in zip(day.knocks, bounds_s[2:], strict=True):
        for first_s, last_s in ((0.0, 10.0), (10.0, 60.0), (60.0, end_s)):
            span_s = knock.at_s + first_s, min(knock.at_s + last_s, end_s)
            spans.append((f"{knock.camera} from {first_s:.0f} s", *span_s))
    for camera in (None, *day.settings.cameras):
        for run in runs:
            times_s, errors_mm = position_errors(day, clocks, log, run, camera)
            cells = []
            for name, start_s, stop_s in spans:
                part = errors_mm[(times_s >= start_s) & (times_s < stop_s)]
                if len(part):
                    cells.append(f"{name} {part.mean():.2f}/{np.percentile(part, 95):.2f}")
            yield f"{camera or 'tracks'} {run}: {', '.join(cells)}"


def watch_rows(
    day: Day, clocks: Clocks, log: Path, fitted: Mapping[str, JointModel], run: str
) -> Iterator[str]:
    """Yield the events of a run with their log times since the start, and the errors of its last poses."""
    poses: dict[tuple[str, int], tuple[float, CameraPose]] = {}
    with Session([log]) as session:
        for message in session.messages(
            [*session.topics(RUN_EVENTS, run), *session.topics(CAMERA_POSES, run)]
        ):
            since_s = clocks.since_s(day, message.log_time_ns)
            if message.topic == RUN_EVENTS.topic_of(run):
                yield f"{since_s:8.1f} s: {message.payload.kind}: {message.payload.text}"
                continue
            for pose in message.payload.poses:
                yield f"{since_s:8.1f} s: pose of {pose.camera}: {pose.state}"
                if pose.state in (MOVED, PARTLY, REPAIRED):
                    poses[pose.camera, pose.since] = since_s, pose
    for (camera, since_ns), (since_s, pose) in poses.items():
        knock = day.knock_of(camera)
        motion = np.zeros(6) if knock is None else np.concatenate([knock.turn_rad, knock.shift_m])
        known = replace(fitted[camera], camera_from_world=pose.camera_from_world, origin_m=pose.position_m)
        misses = find_motion(move_camera(fitted[camera], motion), known)
        turn_deg, shift_mm = np.degrees(np.linalg.norm(misses[:3])), np.linalg.norm(misses[3:]) * MM_PER_M
        nees = float(misses @ np.linalg.solve(pose.covariance, misses)) / 6
        moved_s = clocks.since_s(day, since_ns)
        yield (
            f"{camera} {pose.state}, moved at {moved_s:.1f} s, last pose at {since_s:.1f} s: "
            f"error {turn_deg:.4f} degrees, {shift_mm:.3f} mm, NEES {nees:.2f}"
        )


def _main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path(".cache/rendered_day"))
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--knocks", type=int, default=2, choices=range(len(_KNOCKS) + 1))
    parser.add_argument("--rate-hz", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=39)
    parser.add_argument("--measure", action="store_true", help="only measure the logs of the folder")
    given = parser.parse_args()
    folder = given.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    day = plan_day(given.seed, given.minutes, given.knocks, given.rate_hz)
    for knock in day.knocks:
        print(f"knock of {knock.camera} at {knock.at_s:.1f} s")
    if not given.measure:
        render_logs(day, folder)
        run_commands(folder)
    played = folder / "day.mcap"
    clocks = Clocks.of_logs(folder / "source.mcap", played)
    spread_ms = (max(clocks.shift_ns.values()) - min(clocks.shift_ns.values())) / 1e6
    print(f"the played cameras differ by {spread_ms:.1f} ms from the rendered ones")
    with Session([played]) as session:
        stored = {topic for reader in session.readers for topic in reader.channels}
        runs = sorted(topic.split("/")[2] for topic in stored if re.fullmatch("/runs/[^/]*/tracks", topic))
    with Session([folder / "calibration.mcap"]) as session:
        model: Model = session.payloads(session.topics(MODEL, "joint"))[-1]
    fitted = restore_joint(model)
    for run in runs:
        print(f"\nrun {run}")
        print("\n".join(watch_rows(day, clocks, played, fitted, run)))
    print("\nhorizontal errors in mm, mean/95 % limit")
    print("\n".join(error_rows(day, clocks, played, runs)))


if __name__ == "__main__":
    _main()
