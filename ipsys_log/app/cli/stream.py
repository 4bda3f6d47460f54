"""Positions for other programs: ``ipsys stream``, its keys, and the options of all streams."""

from __future__ import annotations

import functools
import inspect
import os
import re
import select
import sys
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_origin, get_type_hints

from ipsys_log.app.cli.console import say
from ipsys_log.app.cli.options import LogList, Option, flag, log_argument, option, setting, switch
from ipsys_log.app.cli.pages import Web, WebPort, check_dashboard, serve_playback
from ipsys_log.app.cli.signals import allow_interrupt, runs_until_stopped, stop_on_signal, writes_nothing
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.sinks.streams import StreamOption, StreamSettings

if TYPE_CHECKING:
    from ipsys_log.live_runs.player import Player
    from ipsys_log.messages import Rig

# The options of the streams, by the names of `choose_streams`.
StreamOptions = dict[str, Any]

_SEEK_S = 5.0
_TURN_S = 0.1
_LEFT, _RIGHT = "\x1b[D", "\x1b[C"
# An arrow sends three characters.
_KEY = re.compile(r"\x1b\[[A-D]|.", re.DOTALL)
_RATES = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)

Logs = Annotated[LogList, log_argument(help="Logs to play, files or URLs, merged by time.")]
RigFile = Annotated[Path | None, setting("--rig", "FILE", "Open the streams of this rig file (lab.toml).")]
Rate = Annotated[float, setting("--rate", "FACTOR", "Play faster or slower: 2 is twice as fast.")]
Loop = Annotated[bool, switch("--loop", "Begin again at the end.")]
StartPaused = Annotated[bool, switch("--start-paused", "Wait for a key at the start.")]
StartOffset = Annotated[
    float, setting("--start-offset", "SECONDS", "Begin so long after the first position.")
]
Run = Annotated[str | None, setting("--run", "NAME", "Play the tracks of this run. Default: the newest.")]
Topics = Annotated[
    list[str] | None,
    setting("--topics", "TOPIC", "Play this topic instead, such as /truth/tracks; repeat it for several."),
]
Restamp = Annotated[
    str, setting("--restamp", "original|now", "Give the positions their capture times, or the present time.")
]


_PANEL = "Streams of positions"
_option = partial(option, rich_help_panel=_PANEL)


def _options_of(setting: str, described: StreamOption) -> Iterator[tuple[str, Option]]:
    """Yield the option of a setting, and for a server that of its port."""
    name = described.name or f"--{setting.replace('_', '-')}"
    if described.metavar:
        kind = _KINDS[setting]
        kind = list[str] if get_origin(kind) is tuple else kind
        yield setting, _option(kind | None, name, described.metavar, described.help)
    else:
        yield setting, flag(name, described.help, rich_help_panel=_PANEL)
    if described.port is not None:
        port = _option(int | None, f"{name}-port", "PORT", described.port_help, min=1, max=65535)
        yield f"{setting}_port", port


_KINDS = get_type_hints(StreamSettings)
_DESCRIBED = {one.name: one.metadata["option"] for one in fields(StreamSettings) if one.metadata}
_OPTIONS = dict(pair for one in _DESCRIBED.items() for pair in _options_of(*one))


def takes_streams(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of the streams, in place of its keyword ``streams``."""
    signature = inspect.signature(command, eval_str=True)
    parameters = [p for own in signature.parameters.values() for p in _expand(own)]

    @functools.wraps(command)
    def run(**given: Any) -> None:
        streams = {name: given.pop(name) for name in _OPTIONS}
        command(**given, streams=streams)

    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run


def _expand(parameter: inspect.Parameter) -> Iterator[inspect.Parameter]:
    if parameter.name != "streams":
        yield parameter
        return
    for name, (kind, default) in _OPTIONS.items():
        yield inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)


def choose_streams(
    rig: Rig | None, folder: Path, *, has_page: bool = False, **options: Any
) -> StreamSettings:
    """Return the streams of the options; where an option is missing, those of the rig file.

    Parameters
    ----------
    rig : the rig of a file, never of a log: a log opens no socket.
    folder : the folder of the rig file.
    has_page : the command also serves a page at the address of ``host``.
    options : fields of `StreamSettings`; for a server, whether it is wanted, and its port as ``vrpn_port``.
        None, False and empty lists are missing.
    """
    from ipsys_log.messages.rig_file import check_robots
    from ipsys_log.sinks.streams.opening import settings_of_rig

    for name, described in _DESCRIBED.items():
        if described.port is not None:
            usual = described.port if options.pop(name) else None
            options[name] = options.pop(f"{name}_port") or usual
    given: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in options.items()
        if value is not None and value is not False and value != []
    }
    settings = replace(settings_of_rig(None if rig is None else rig.stream, folder), **given)
    _check_effect(given.keys() - {"host"} if has_page else given, settings)
    if rig is not None:
        check_robots(rig, settings.named_robots, "--robot")
    return settings


def _check_effect(given: Collection[str], settings: StreamSettings) -> None:
    """Check that each option belongs to a stream."""
    if given and not settings:
        name = next(iter(given)).replace("robots", "robot").replace("_", "-")
        raise IpsysError(f"--{name}: has no effect without a stream; add one, such as --udp 127.0.0.1:9870")
    if "ros2_domain" in given and settings.ros2 is None:
        raise IpsysError("--ros2-domain: has no effect without ROS 2; add --ros2")
    if "images" in given and not settings.has_viewer:
        raise IpsysError("--images: has no effect without a viewer; add --foxglove or --rerun")


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

    Examples

        ipsys stream monday.mcap --udp 127.0.0.1:9870 --rate 2
        ipsys stream monday.mcap --udp 192.168.1.20:9870 --host 0.0.0.0 --loop
        ipsys stream monday.mcap --vrpn --start-offset 20    # port 3883
    """
    allow_interrupt("stopped before the first position was sent")
    from ipsys_log.live_runs.player import Player
    from ipsys_log.messages.rig_file import load_rig
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
    port = check_dashboard(web, streams["host"], web_port)
    options = PlaybackOptions(rate, loop, start_paused, start_offset, restamp == "now")
    player = Player(logs, run, topics or (), options, settings, say=say, has_dashboard=web)
    stop_on_signal(player.stop)
    with serve_playback(player, streams["host"], port), player:
        for line in player.lines:
            say(line)
        with read_keys(player, say):
            say(f"playing {', '.join(player.runs) or 'ground truth'}: {player.duration_s:.1f} s")
            player.wait()


@contextmanager
def read_keys(player: Player, say: Callable[[str], None]) -> Iterator[None]:
    """Let the keys of the terminal control a player; without a terminal, or in the background, do nothing.

    The terminal gets its settings back at the end of the block.
    """
    if not (sys.stdin.isatty() and _is_in_foreground(sys.stdin.fileno())):
        yield
        return
    import termios  # only this function needs a terminal, and some systems have none
    import tty

    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    ended = threading.Event()
    reader = threading.Thread(target=_read, args=(terminal, player, say, ended), name="keys", daemon=True)
    try:
        tty.setcbreak(terminal, termios.TCSANOW)  # keys that wait are kept
        reader.start()
        yield
    finally:
        ended.set()
        reader.join()
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _is_in_foreground(terminal: int) -> bool:
    """Return False for a background job: the system stops one that changes or reads its terminal."""
    try:
        return os.tcgetpgrp(terminal) == os.getpgrp()
    except OSError:  # the terminal of no other job
        return True


def _read(terminal: int, player: Player, say: Callable[[str], None], ended: threading.Event) -> None:
    while not ended.is_set():
        if select.select([terminal], [], [], _TURN_S)[0]:
            pressed = os.read(terminal, 16).decode(errors="replace")
            if not pressed:  # the terminal was closed
                return
            for key in _KEY.findall(pressed):
                press(player, key)
            state = "paused" if player.is_paused else f"rate {player.rate:g}"
            loops = ", loop" if player.loop else ""
            say(f"{player.position_s:.2f} of {player.duration_s:.2f} s, {state}{loops}")


def press(player: Player, key: str) -> None:
    """Carry out the command of a key; ignore all other keys."""
    if key == " ":
        if player.is_paused:
            player.resume()
        else:
            player.pause()
    elif key == ".":
        player.step()
    elif key in (_LEFT, _RIGHT):
        player.seek(player.position_s + (_SEEK_S if key == _RIGHT else -_SEEK_S))
    elif key == "+":
        player.rate = min((rate for rate in _RATES if rate > player.rate), default=player.rate)
    elif key == "-":
        player.rate = max((rate for rate in _RATES if rate < player.rate), default=player.rate)
    elif key == "l":
        player.loop = not player.loop
    elif key == "q":
        player.stop()
