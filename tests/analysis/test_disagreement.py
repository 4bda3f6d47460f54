"""Disagreement of cameras in their overlap, against known differences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    IMPORTED,
    ChannelWritten,
    Message,
    Position,
    Positions,
    ReferenceMarker,
    Rig,
    Run,
)
from ipsys_log.statistics.disagreement import (
    CameraPositions,
    OverlapStream,
    OverlapSummary,
    compare_cameras,
    divide_floor,
    divide_time,
    read_disagreement,
)
from ipsys_log.units import NS_PER_S
from tests.conftest import Ipsys

STEP_NS = NS_PER_S // 30
# Greatest distance of an arc from its chord of one frame, v^2 t^2 / 8 r, for 0.26 m/s and a radius of 0.5 m.
SAGITTA_M = 0.26**2 / 30**2 / (8 * 0.5) + 1e-6


def seen(
    camera: str, offset_m: tuple[float, float], late_ns: int = 0, count: int = 90, sigma_m: float = 0.001
) -> CameraPositions:
    """Return the positions of a robot on a circle, at 0.26 m/s, by a camera with a constant error."""
    times_ns = 1000 * NS_PER_S + late_ns + STEP_NS * np.arange(count)
    turn = 0.26 / 0.5 * (times_ns - 1000 * NS_PER_S) / NS_PER_S
    points_m = np.column_stack([2 + 0.5 * np.cos(turn), 2 + 0.5 * np.sin(turn)]) + offset_m
    covariances = np.broadcast_to(sigma_m**2 * np.eye(2), (count, 2, 2))
    return CameraPositions(camera, np.zeros(count, dtype=np.int64), times_ns, points_m, covariances)


@given(st.integers(0, STEP_NS - 1), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01))
@settings(max_examples=20)
def test_constant_difference_is_found_for_cameras_out_of_step(late_ns: int, x_m: float, y_m: float) -> None:
    (pair,) = compare_cameras([seen("b", (0.0, 0.0), late_ns), seen("a", (x_m, y_m))])
    assert pair.cameras == ("a", "b")
    assert np.abs(pair.differences_m - [x_m, y_m]).max() < SAGITTA_M
    assert pair.median_m == pytest.approx(np.hypot(x_m, y_m), abs=2e-5)


def test_cameras_in_step_are_compared_at_the_same_instants() -> None:
    (pair,) = compare_cameras([seen("a", (0.003, 0.0)), seen("b", (0.0, 0.0))])
    assert len(pair.times_ns) == 89
    assert np.allclose(pair.differences_m, [0.003, 0.0], atol=1e-12)


def test_gap_of_more_than_the_limit_is_not_bridged() -> None:
    whole = seen("b", (0.0, 0.0), 5)
    kept = np.r_[0:30, 60:90]
    split = CameraPositions(
        "b", whole.ids[kept], whole.times_ns[kept], whole.points_m[kept], whole.covariances_m2[kept]
    )
    (pair,) = compare_cameras([seen("a", (0.001, 0.0)), split])
    inside = (pair.times_ns > whole.times_ns[29]) & (pair.times_ns < whole.times_ns[60])
    assert not inside.any()
    assert len(pair.times_ns) == 58


@pytest.mark.parametrize(("factor", "low", "high"), [(1.0, 0.90, 0.99), (3.0, 0.0, 0.5)])
def test_share_within_the_covariance_shows_overconfidence(factor: float, low: float, high: float) -> None:
    rng, pair = np.random.default_rng(1), []
    for camera in ("a", "b"):
        own = seen(camera, (0.0, 0.0), count=600)
        noisy_m = own.points_m + rng.normal(0, factor * 0.001, own.points_m.shape)
        pair.append(CameraPositions(camera, own.ids, own.times_ns, noisy_m, own.covariances_m2))
    (found,) = compare_cameras(pair)
    assert found.within_95 is not None
    assert low <= found.within_95 <= high


def test_other_robots_and_single_cameras_have_no_disagreement() -> None:
    one = seen("a", (0.0, 0.0))
    other = CameraPositions("b", one.ids + 1, one.times_ns, one.points_m, one.covariances_m2)
    assert compare_cameras([one]) == []
    assert compare_cameras([one, other]) == []


def test_cells_and_intervals_contain_all_differences_once() -> None:
    pairs = compare_cameras([seen("a", (0.002, 0.0), count=900), seen("b", (0.0, 0.0), 7, 900)])
    cells, intervals = divide_floor(pairs), divide_time(pairs[0])
    rest = 2 * len(cells)
    assert sum(cell.count for cell in cells) >= len(pairs[0].times_ns) - rest
    assert sum(one.count for one in intervals) == len(pairs[0].times_ns)
    assert all(cell.median_m == pytest.approx(0.002, abs=2e-5) for cell in cells)


def messages(late_ns: int) -> list[Message]:
    rows = []
    for own in (seen("a", (0.003, -0.001)), seen("b", (0.0, 0.0), late_ns)):
        for time_ns, (x_m, y_m) in zip(own.times_ns.tolist(), own.points_m.tolist(), strict=True):
            robot = Position(0, x_m, y_m, 0.0, covariance_m2=1e-6 * np.eye(3))
            fixed = Position(90, 1.0, 1.0 if own.camera == "a" else 2.0, 0.0)
            lost = Position(3, 1.0, 1.0 if own.camera == "a" else 2.0, 0.0, inside=False)
            topic = f"/runs/joint/cameras/{own.camera}/positions"
            rows.append(
                Message(topic, time_ns, time_ns, Positions(time_ns, (robot, lost, fixed)), own.camera)
            )
    return sorted(rows, key=lambda message: message.log_time_ns)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Return a log with positions of a robot and of a reference marker."""
    rows, path = messages(STEP_NS // 3), tmp_path / "lab.mcap"
    rig = Rig("lab", "DICT_4X4_100", 0.2, reference_markers=(ReferenceMarker(90),))
    outputs = tuple(ChannelWritten(f"/runs/joint/cameras/{name}/positions", 90) for name in "ab")
    run = Run(0, "joint", IMPORTED, {}, outputs=outputs)
    last_ns = rows[-1].log_time_ns
    first = Message("/rig", rows[0].log_time_ns, 0, rig)
    write_log(path, [first, *rows, Message("/runs/joint/record", last_ns, last_ns, run)])
    return path


def test_log_and_stream_have_the_same_differences(log: Path) -> None:
    with Session([log]) as session:
        (pair,) = read_disagreement(session, "joint", {90})
    stream = OverlapStream(Rig("lab", "DICT_4X4_100", 0.2, reference_markers=(ReferenceMarker(90),)))
    live = [one for message in messages(STEP_NS // 3) for one in stream(message)]
    assert {one.cameras for one in live} == {("a", "b")}
    middle_m = np.median([(one.x_m, one.y_m) for one in live], axis=0)
    assert middle_m == pytest.approx(np.median(pair.differences_m, axis=0), abs=SAGITTA_M)
    assert middle_m == pytest.approx([0.003, -0.001], abs=SAGITTA_M)


def test_display_has_one_line_for_each_pair() -> None:
    summary = OverlapSummary()
    rig = Rig("lab", "DICT_4X4_100", 0.2, reference_markers=(ReferenceMarker(90),))
    for message in [Message("/rig", 0, 0, rig), *messages(STEP_NS // 3)]:
        summary(message)
    assert summary.lines() == ["positions of cameras a and b differ by 3.2 mm (median), 3.2 mm (p95)"]


def test_display_of_many_pairs_has_the_worst_ones() -> None:
    """Camera k is wrong by k mm: the pairs with the last camera differ most."""
    summary, cameras = OverlapSummary(), "abcdefgh"
    for number in range(30):
        for offset, camera in enumerate(cameras):
            time_ns = number * STEP_NS + offset * 1_000_000
            row = Positions(time_ns, (Position(1, offset / 1000, 0.0, 0.1),))
            topic = f"/runs/poly/cameras/{camera}/positions"
            summary(Message(topic, time_ns, time_ns, row, camera))
    *lines, rest = summary.lines()
    assert [line.split()[3] + line.split()[5] for line in lines] == ["af", "ag", "ah", "bg", "bh", "ch"]
    assert rest == "the other 22 pairs of cameras differ less"


def test_info_shows_the_disagreement(log: Path, ipsys: Ipsys) -> None:
    shown = ipsys("info", log)
    assert (shown.code, shown.err) == (0, "")
    row = next(line for line in shown.out.splitlines() if line.startswith("a and b"))
    assert row.split()[3:6] == ["89", "3.2", "3.2"]


def test_impossible_positions_cause_no_traceback(tmp_path: Path, ipsys: Ipsys) -> None:
    def write(name: str, position: Position) -> Path:
        rows = [
            Message(
                one.topic,
                one.log_time_ns,
                one.publish_time_ns,
                Positions(one.publish_time_ns, (position,)),
                one.camera,
            )
            for one in messages(5)
        ]
        outputs = tuple(ChannelWritten(f"/runs/joint/cameras/{camera}/positions", 90) for camera in "ab")
        record = Message(
            "/runs/joint/record", rows[-1].log_time_ns, 0, Run(0, "joint", IMPORTED, {}, outputs=outputs)
        )
        write_log(tmp_path / name, [*rows, record])
        return tmp_path / name

    lost = ipsys("info", write("nan.mcap", Position(0, float("nan"), 1e300, 0.0)))
    assert (lost.code, lost.err, "Disagreement" in lost.out) == (0, "", False)
    odd = ipsys("info", write("odd.mcap", Position(0, 1.0, 1.0, 0.0, covariance_m2=np.eye(2))))
    assert (odd.code, odd.err.count("\n")) == (1, 1)
    assert "covariances that are not 3 x 3" in odd.err
