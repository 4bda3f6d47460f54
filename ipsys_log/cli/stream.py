"""The player: ``ipsys stream``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ipsys_log.cli.console import say
from ipsys_log.cli.dashboard import Web, WebPort, check_playback_page, serve_playback
from ipsys_log.cli.options import LogList, log_argument
from ipsys_log.cli.signals import allow_interrupt, runs_until_stopped, stop_on_signal, writes_nothing
from ipsys_log.cli.stream_options import StreamOptions, choose_streams, takes_streams

Logs = Annotated[LogList, log_argument(help="Logs to play, files or URLs, merged by time.")]
RigFile = Annotated[
    Path | None,
    typer.Option("--rig", metavar="FILE", help="Open the streams of this rig file (lab.toml)."),
]
Rate = Annotated[
    float, typer.Option("--rate", metavar="FACTOR", help="Play faster or slower: 2 is twice as fast.")
]
Loop = Annotated[bool, typer.Option("--loop", help="Begin again at the end.")]
StartPaused = Annotated[bool, typer.Option("--start-paused", help="Wait for a key at the start.")]
StartOffset = Annotated[
    float,
    typer.Option("--start-offset", metavar="SECONDS", help="Begin so long after the first position."),
]
Run = Annotated[
    str | None,
    typer.Option("--run", metavar="NAME", help="Play the tracks of this run. Default: the newest."),
]
Topics = Annotated[
    list[str] | None,
    typer.Option(
        "--topics",
        metavar="TOPIC",
        help="Play this topic instead, such as /truth/tracks; repeat it for several.",
    ),
]
Restamp = Annotated[
    str,
    typer.Option(
        "--restamp",
        metavar="original|now",
        help="Give the positions their capture times, or the present time.",
    ),
]


def add_commands(app: typer.Typer) -> None:
    app.command()(stream)


@runs_until_stopped
@writes_nothing
@takes_streams
def stream(
    logs: Logs,
    *,
    streams: StreamOptions,
    rig: RigFile = None,
    rate: Rate = 1.0,
    loop: Loop = False,
    start_paused: StartPaused = False,
    start_offset: StartOffset = 0.0,
    run: Run = None,
    topics: Topics = None,
    restamp: Restamp = "original",
    web: Web = False,
    web_port: WebPort = None,
) -> None:
    """Play logs as if they were live: send their positions to robots and other programs.

    The positions are those of a run; the command computes none. Keys: space pauses, . plays the next
    position, left and right move by 5 s, + and - change the rate, l loops, q ends. With --rig lab.toml, the
    command opens the streams of this file; a log itself opens no stream. With --web, a page shows the log.
    """
    allow_interrupt("stopped before the first position was sent")
    from ipsys_log.cli.keys import read_keys
    from ipsys_log.errors import IpsysError
    from ipsys_log.extras import check_installed
    from ipsys_log.player import Player
    from ipsys_log.rig.file import load_rig
    from ipsys_log.sinks.playback import PlaybackOptions

    if restamp not in ("original", "now"):
        raise IpsysError(f"--restamp {restamp}: is not known; use original or now")
    if web:
        check_installed("--web needs", "starlette", "uvicorn")
    described = None if rig is None else load_rig(rig)
    folder = Path() if rig is None else rig.parent
    settings = choose_streams(described, folder, has_page=web, **streams)
    if not settings and not web:
        raise IpsysError("no stream is given; name one, such as --udp 127.0.0.1:9870, or add --web")
    port = check_playback_page(web, streams["host"], web_port)
    options = PlaybackOptions(rate, loop, start_paused, start_offset, restamp == "now")
    player = Player(logs, run, topics or (), options, settings, say=say, has_dashboard=web)
    stop_on_signal(player.stop)
    with serve_playback(player, streams["host"], port), player:
        for line in player.lines:
            say(line)
        with read_keys(player, say):
            say(f"playing {', '.join(player.runs) or 'ground truth'}: {player.duration_s:.1f} s")
            player.wait()
