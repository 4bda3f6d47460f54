"""All commands on the simulated lab, compared with its ground truth."""

import csv
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.app.cli.app import panels
from ipsys_log.capture.simulation.cameras import mount_cameras
from ipsys_log.capture.simulation.live_lab import LIVE_SETTINGS, image_index, lab_film, plan_live_lab
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    RIG_TOPIC,
    CompressedImage,
    Distance,
    Measurement,
    Message,
    Rig,
    calibration_topic,
    image_topic,
)
from ipsys_log.messages.channels import TRACKS
from ipsys_log.messages.rig_file import load_rig
from ipsys_log.units import NS_PER_S
from tests.conftest import Ipsys

# a limit for one command on a busy machine; a free machine needs seconds
PATIENCE_S = 900


def errors_m(log: Path, run: str = "joint") -> np.ndarray:
    """Return the distances between the tracks of a log and the true simulated positions, (n,), in m."""
    lab = plan_live_lab(LIVE_SETTINGS)
    lying = {where.marker_id: where for where in lab.stationary}
    offsets = []
    with Session([log]) as session:
        for tracks in session.payloads(session.topics(TRACKS, run)):
            frame = round(tracks.timestamp * LIVE_SETTINGS.rate_hz / 1e9)
            time_s = lab.time_of(image_index(frame, lab.images))
            for track in tracks.tracks:
                true = lying.get(track.id) or lab.drive.pose_at(track.id, time_s)
                offsets.append((track.x_m - true.x_m, track.y_m - true.y_m, track.z_m - true.z_m))
    return np.asarray(np.linalg.norm(np.array(offsets).reshape(-1, 3), axis=1))


def sheet_rows(path: Path) -> list[Measurement]:
    with path.open() as file:
        return [
            Measurement(
                0,
                f"m{row['marker']}",
                marker_id=int(row["marker"]),
                distances=tuple(Distance(name, float(row[f"d_{name}_cm"]) / 100) for name in "AB"),
                side=row["side"],
                height_m=float(row["height_cm"]) / 100,
            )
            for row in csv.DictReader(file)
        ]


def test_simulated_lab_gives_its_rig_and_its_tape(
    ipsys: Ipsys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = ipsys("init", "lab.toml", "--simulated")
    assert done.code == 0, done.err
    rig = load_rig(tmp_path / "lab.toml")
    assert [camera.source for camera in rig.cameras] == ["sim:red", "sim:white", "sim:black"]
    lying = {where.marker_id: where for where in plan_live_lab(LIVE_SETTINGS).stationary}
    rows = sheet_rows(tmp_path / "lab_tape.csv")
    assert sorted(row.marker_id or 0 for row in rows) == sorted(lying)
    known = {point.name: point for point in rig.reference_points}
    for row in rows:
        where = lying[row.marker_id or 0]
        assert rig.height_of(where.marker_id) == row.height_m == where.z_m
        for tape in row.distances:
            a = known[tape.reference]
            assert abs(np.hypot(where.x_m - a.x_m, where.y_m - a.y_m) - tape.distance_m) < 0.001
    before = (tmp_path / "lab_tape.csv").read_bytes()
    assert "lab.toml: exists already" in ipsys("init", "--simulated").err
    assert ".: exists already" in ipsys("init", ".", "--simulated").err
    # Both files are there, or none.
    (tmp_path / "lab.toml").unlink()
    done = ipsys("init", "lab.toml", "--simulated")
    assert (done.code, (tmp_path / "lab.toml").exists()) == (1, False)
    assert "lab_tape.csv: exists already" in done.err
    assert (tmp_path / "lab_tape.csv").read_bytes() == before
    assert "cannot be used together" in ipsys("init", "x.toml", "--simulated", "--from", "a.mcap").err


def test_simulated_lab_is_measured_and_fitted(
    ipsys: Ipsys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A short simulated day, without its real time: the sheet fits the frames to the centimetre."""
    monkeypatch.chdir(tmp_path)
    assert ipsys("init", "--simulated").code == 0
    write_log(tmp_path / "day.mcap", seen_by_all(load_rig(tmp_path / "lab.toml")))
    done = ipsys("measure", "day.mcap", "--csv", "lab_tape.csv")
    assert done.code == 0, done.err
    assert f"{len(sheet_rows(tmp_path / 'lab_tape.csv'))} points measured" in done.out
    assert ipsys("replay", "day.mcap").code == 0
    errors = errors_m(tmp_path / "day.mcap")
    assert len(errors) > 150
    assert np.median(errors) < 0.005
    assert np.percentile(errors, 95) < 0.03


def seen_by_all(rig: Rig) -> Iterator[Message]:
    """Return the frames of all three cameras in half a second."""
    step_ns = round(NS_PER_S / LIVE_SETTINGS.rate_hz)
    start_ns = 1_700_000_000 * NS_PER_S
    films = [lab_film(LIVE_SETTINGS, number, lambda: None) for number in range(3)]
    yield Message(RIG_TOPIC, start_ns - step_ns, start_ns - step_ns, rig)
    for number, camera in enumerate(mount_cameras(LIVE_SETTINGS)):
        time_ns = start_ns - step_ns + 1 + number
        yield Message(calibration_topic(camera.name), time_ns, time_ns, camera.lens, camera.name)
    for frame in range(5):
        time_ns = start_ns + frame * step_ns
        for order, film in enumerate(films):
            name = LIVE_SETTINGS.cameras[order]
            data = film.draw(film.index_of(round(time_ns * LIVE_SETTINGS.rate_hz / NS_PER_S)))
            image = CompressedImage(time_ns, name, data, "jpeg")
            yield Message(image_topic(name), time_ns + 5_000_000 + order, time_ns, image, name)


class Day:
    """A runner of commands as programs in a folder, with a list of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.commands: set[str] = set()

    def __call__(self, *arguments: object) -> str:
        self.commands.add(str(arguments[0]))
        done = subprocess.run(
            [sys.executable, "-m", "ipsys_log", *map(str, arguments)],
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert done.returncode == 0, f"{arguments}: {done.stderr}"
        assert "Traceback" not in done.stderr
        return done.stdout


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Day:
    return Day(tmp_path_factory.mktemp("day"))


@pytest.mark.slow
def test_every_command_of_the_first_day_works_without_hardware(day: Day) -> None:
    day("init", "lab.toml", "--simulated")
    day("markers", "--rig", "lab.toml")
    day("cameras", "--rig", "lab.toml")
    cameras = {camera.name: camera for camera in mount_cameras(LIVE_SETTINGS)}

    board = ("--board", "6x4", "--camera", "red", "--seconds", 8)
    (found,) = json.loads(day("calibrate", "--rig", "lab.toml", *board, "--json"))["rows"]
    assert abs(found["parameters"]["fx"] / cameras["red"].lens.K[0, 0] - 1) < 0.005
    lenses = ("--calibration", "red=red.yaml")

    aligned = json.loads(day("align", "--rig", "lab.toml", *lenses, "--json"))
    for one in aligned["cameras"]:
        down = cameras[one["camera"]].camera_from_world[:3, 2]
        assert abs(one["tilt_rad"] - np.arccos(-down[2])) < np.radians(0.3)

    day("record", "--rig", "lab.toml", *lenses, "-o", "session.mcap", "--seconds", 10)
    day("measure", "session.mcap", "--csv", "lab_tape.csv")
    lab = json.loads(day("calibrate-lab", "session.mcap", *lenses, "--json"))
    assert 0.0001 < lab["mean_m"] < 0.005
    day("live", "--rig", "lab.toml", *lenses, "--model-from", "session.mcap", "-o", "a.mcap", "--seconds", 8)
    errors = errors_m(day.folder / "a.mcap")
    assert len(errors) > 100
    assert np.median(errors) < 0.01
    assert np.percentile(errors, 95) < 0.05

    assert "the replay is identical to the log" in day("verify", "a.mcap")
    day("cut", "a.mcap", "-o", "part.mcap", "--start", 2)
    assert "channels have the messages of the cut" in day("verify", "part.mcap")
    day("cut", "a.mcap", "-o", "red.mcap", "--camera", "red")
    day("cut", "a.mcap", "-o", "rest.mcap", "--camera", "white", "--camera", "black")
    # A busy machine skips frames, so the markers of a live run may not determine the offset.
    day("merge", "red.mcap", "rest.mcap", "-o", "both.mcap", "--offset", "rest=0")
    day("exclude", "session.mcap", "p001", "--reason", "the tape sagged")
    day("exclude", "session.mcap", "p001", "--readmit", "--reason", "the tape was straight")
    day("cut", "session.mcap", "--compact", "--dry-run")
    day("verify", "a.mcap", "a.mcap", "--compare")
    day("repair", "a.mcap")
    day("info", "a.mcap")
    day("info", "a.mcap", "--runs", "--sizes", "--latency", "--plot", "latency.png")
    day("cat", "a.mcap", "--topics", "/events")
    day("view", "a.mcap", "--save", "a.rrd")
    day("stream", "a.mcap", "--udp", "9870", "--rate", 10)
    day("evaluate", "session.mcap", "--model", "poly")
    day("plan", "session.mcap", "--places", 2)
    day("report", "session.mcap", "--model", "poly")  # all models take minutes
    day("export", "a.mcap", "-o", "a.csv")
    day("pack", "--card-form", "card.toml")
    form = (day.folder / "card.toml").read_text()
    for key, value in (("title", '"Day"'), ("authors", '["Lab"]'), ("licence", '"CC0-1.0"')):
        form = form.replace(f'{key} = ""' if key != "authors" else "authors = []", f"{key} = {value}")
    (day.folder / "card.toml").write_text(form)
    pack = ("-o", "dataset.zip", "--card", "card.toml", "--model", "rigid", "--without-images")
    day("pack", "session.mcap", *pack)
    assert "come out as stated" in day("score", "dataset.zip")
    day("export", "a.mcap", "-o", "bag.mcap", "--format", "ros2")
    day("export", "a.mcap", "-o", "a.mp4", "--size", "320x180", "--frame-rate", 5)
    day("export", "a.mcap", "-o", "coco", "--format", "coco")
    day("replay", "session.mcap", "--until", "smooth")
    settings = ("width=960", "height=540", "stations=4", "drive_s=1")
    day("simulate", "-o", "s.mcap", *(word for setting in settings for word in ("--set", setting)))
    day("check", "s.mcap")
    day("catalogue", ".", "-o", "catalogue.parquet")
    # These have tests of their own: a page, public data, weeks of logs, odometry, bodies, robots and hosts.
    day.commands |= {"setup", "import", "drift", "compare", "calibrate-body", "drive", "batch", "node"}
    assert day.commands == {name for names in panels().values() for name in names}
