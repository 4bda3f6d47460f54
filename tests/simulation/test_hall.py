"""A hall: cameras in a grid that see its whole floor, and robots that drive over all of it."""

from pathlib import Path

import numpy as np
import pytest

from ipsys_log.capture.simulation.cameras import mount_cameras, sees
from ipsys_log.capture.simulation.drive import LanePath, plan_drive
from ipsys_log.capture.simulation.settings import LabSettings, hall_settings, parse_grid
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Markers, Rig
from ipsys_log.messages.rig_file import check_rig
from tests.conftest import Ipsys
from tests.geometric.lab import GeometricSettings, build_lab, poses_over
from tests.geometric.session import simulate_session


def test_every_place_of_a_hall_is_seen_and_neighbours_overlap() -> None:
    hall = hall_settings(6, 4)
    x, y = np.meshgrid(*(np.linspace(0.15, size_m - 0.15, 50) for size_m in hall.floor_m))
    places_m = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, hall.drive_height_m)])
    seen = {camera.name: sees(camera, places_m) for camera in mount_cameras(hall)}
    assert np.any(list(seen.values()), axis=0).all()
    for name, own in seen.items():
        letter, number = name[0], int(name[1])
        for neighbour in (f"{chr(ord(letter) + 1)}{number}", f"{letter}{number + 1}"):
            assert neighbour not in seen or (own & seen[neighbour]).any(), (name, neighbour)


@pytest.mark.parametrize("grid", [(1, 1), (2, 1), (6, 4), (12, 12)])
def test_lanes_stay_inside_the_hall_and_apart(grid: tuple[int, int]) -> None:
    floor_m = hall_settings(*grid).floor_m
    path = LanePath(floor_m, 2 * grid[0], mirrored=True)
    phases = np.linspace(-np.pi / 2, 1.5 * np.pi, 3001)
    (x_m, y_m), (dx, dy) = path.at(phases)
    assert min(x_m.min(), y_m.min(), floor_m[0] - x_m.max(), floor_m[1] - y_m.max()) > 0.5
    step = 1e-6
    (x_later, y_later), _ = path.at(phases[1:-1] + step)
    (x_before, y_before), _ = path.at(phases[1:-1] - step)
    slopes = np.stack([x_later - x_before, y_later - y_before]) / (2 * step)
    assert np.abs(slopes - [dx[1:-1], dy[1:-1]]).max() < 1e-2 * np.hypot(dx, dy).max()
    # Places of the path that are far apart along it keep a robot's width between them.
    way_m = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x_m), np.diff(y_m)))])
    flat_m = np.column_stack([x_m, y_m])[::5]
    apart_m = np.linalg.norm(flat_m[:, None] - flat_m, axis=2)
    along_m = np.abs(way_m[::5, None] - way_m[::5])
    along_m = np.minimum(along_m, way_m[-1] - along_m)
    assert apart_m[along_m > 2.5].min() > 0.5


def test_robots_of_a_hall_pass_every_camera() -> None:
    hall = hall_settings(3, 2, markers=12, drive_s=30.0)
    drive = plan_drive(hall, mount_cameras(hall))
    assert len(drive.ahead_s) == 12
    times_s = np.linspace(0, hall.drive_s, 61)
    paths_m = [np.insert(poses_over(drive, n, times_s)[:, :2], 2, hall.drive_height_m, 1) for n in range(12)]
    for camera in mount_cameras(hall):
        assert sum(sees(camera, path_m).any() for path_m in paths_m) >= 2


def test_geometric_session_has_the_cameras_of_the_grid() -> None:
    hall = hall_settings(3, 2, markers=4, rate_hz=5.0, drive_s=2.0)
    messages = list(simulate_session(build_lab(GeometricSettings(lab=hall, points=8))))
    rig = next(message.payload for message in messages if isinstance(message.payload, Rig))
    check_rig(rig, "the rig of the hall")
    assert [camera.name for camera in rig.cameras] == ["a1", "a2", "b1", "b2", "c1", "c2"]
    assert rig.floor is not None
    assert (rig.floor.width_m, rig.floor.depth_m) == pytest.approx((10.0, 7.5))
    seen = {m.camera for m in messages if isinstance(m.payload, Markers) and m.payload.markers}
    assert seen == {"a1", "a2", "b1", "b2", "c1", "c2"}


@pytest.mark.parametrize(
    ("grid", "said"),
    [
        ("0x4", "give 1 to 12 columns"),
        ("40x40", "give 1 to 12 columns"),
        ("6y4", "is not a grid; give columns x rows, such as 6x4"),
        ("red,white", "is not a grid"),
        ("-1x4", "is not a grid"),
        ("", "is not a grid"),
    ],
)
def test_wrong_grid_is_one_line(grid: str, said: str, ipsys: Ipsys, tmp_path: Path) -> None:
    done = ipsys("simulate", "-o", tmp_path / "hall.mcap", f"--cameras={grid}")
    assert (done.code, len(done.err.strip().splitlines())) == (1, 1)
    assert said in done.err
    assert not (tmp_path / "hall.mcap").exists()


def test_grid_and_cameras_must_agree() -> None:
    assert parse_grid("12x1") == (12, 1)
    with pytest.raises(IpsysError, match="3 cameras for a grid of 6 x 4"):
        LabSettings(grid=(6, 4))


@pytest.mark.slow
def test_command_writes_a_log_with_all_cameras(ipsys: Ipsys, tmp_path: Path) -> None:
    log, size = tmp_path / "hall.mcap", ["--width", "320", "--height", "180"]
    short = ["--stations", "0", "--drive-s", "0.1", "--rate-hz", "10"]
    done = ipsys("simulate", "-o", log, "--cameras", "2x2", *size, *short)
    assert done.code == 0, done.err
    assert ipsys("init", tmp_path / "lab.toml", "--from", log).code == 0
    text = (tmp_path / "lab.toml").read_text()
    assert all(f'name = "{name}"' in text for name in ("a1", "a2", "b1", "b2"))
