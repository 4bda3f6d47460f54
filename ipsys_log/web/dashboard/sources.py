"""The dashboards of a live recording, and of a played log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ipsys_log.capture.lab import OpenLab
from ipsys_log.capture.live_check import FrameCheck
from ipsys_log.messages import Model
from ipsys_log.player import Player
from ipsys_log.sinks.played_topics import PlayedScene
from ipsys_log.sinks.streams.settings import Stream
from ipsys_log.web.dashboard.operator import Operator
from ipsys_log.web.dashboard.state import Dashboard, DashboardSetting, PlayedLog
from ipsys_log.web.operator_seat import OperatorSeat


def dashboard_of_recording(
    opened: OpenLab,
    checks: Mapping[str, FrameCheck],
    log: Path,
    model: Model,
    run: str,
    streams: Sequence[Stream],
    seat: OperatorSeat | None = None,
) -> Dashboard:
    """Return the dashboard of a live recording, with an operator.

    Parameters
    ----------
    opened : the open cameras.
    checks : last checks of the cameras, by name.
    log, model, run : the log that is written, the fitted model, and the run of its tracks.
    streams : the streams of positions.
    seat : the seat of the device that operates, if another page has it, too.

    Raises
    ------
    IpsysError
        The model or the intrinsics of a camera are not valid.
    """
    cameras, now_ns = opened.cameras, opened.cameras.clock.now_ns
    setting = DashboardSetting(
        opened.rig, opened.lenses, model, run, cameras.states, checks, log, now_ns, streams
    )
    return Dashboard(setting, Operator(cameras.add, now_ns, cameras.say, seat))


def dashboard_of_player(player: Player, scene: PlayedScene) -> Dashboard:
    """Return the dashboard of a played log. It has no operator: a log is not changed.

    Raises
    ------
    IpsysError
        The model or the intrinsics of a camera are not valid.
    """
    played = PlayedLog(player, scene)
    rig, lenses, model, run = scene.rig, scene.lenses, scene.model, scene.run
    log = Path(scene.name)
    setting = DashboardSetting(
        rig, lenses, model, run, played.states, {}, log, player.now_ns, player.streams, played
    )
    return Dashboard(setting)
