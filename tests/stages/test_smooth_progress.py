"""The progress of *smooth* on a log: its bar moves while frames are read, filtered and smoothed."""

from __future__ import annotations

from pathlib import Path

from ipsys_log.engine.output import write_log
from ipsys_log.engine.view import LogView
from ipsys_log.log.dataset import Session
from ipsys_log.messages import RIG_TOPIC, Message, Position, Positions, Rig, RigMarker
from ipsys_log.messages.channels import POSITIONS
from ipsys_log.stages import smooth

FRAMES, STEP_NS = 50, 30_000_000


def write_positions(path: Path) -> None:
    rig = Rig("lab", "DICT_4X4_100", 0.2, markers=(RigMarker(1, robot="ada"),))
    messages = [Message(RIG_TOPIC, 0, 0, rig)]
    for number in range(1, FRAMES + 1):
        time_ns = number * STEP_NS
        positions = Positions(time_ns, (Position(1, 1 + 0.01 * number, 2.0, 0.1),))
        messages.append(Message("/runs/poly/cameras/red/positions", time_ns + 5, time_ns, positions, "red"))
    write_log(path, messages)


def test_progress_of_smooth_moves_with_each_frame(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    write_positions(path)
    told: list[tuple[int, int]] = []
    with Session([path]) as session:
        plan = smooth.STAGE.plan(LogView(session, {POSITIONS: "poly"}), {})
        assert not isinstance(plan, str)
        assert plan.compute is not None
        rows = list(plan.compute(lambda done, total: told.append((done, total))))
    assert len(rows) == FRAMES
    total = told[0][1]
    assert {one for _, one in told} == {total}
    done = [one for one, _ in told]
    assert (done[0], done[-1]) == (0, total)
    assert done == sorted(done)
    # A bar begins with 0: another 0 would be another bar.
    assert done.count(0) == 1
    # Reading and filtering count frame by frame.
    assert len(set(done)) > 2 * FRAMES
