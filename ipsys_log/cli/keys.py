"""Keys of a terminal that control a player."""

from __future__ import annotations

import os
import re
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ipsys_log.player import Player

_SEEK_S = 5.0
_TURN_S = 0.1
_LEFT, _RIGHT = "\x1b[D", "\x1b[C"
# An arrow sends three characters.
_KEY = re.compile(r"\x1b\[[A-D]|.", re.DOTALL)
_RATES = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)


@contextmanager
def read_keys(player: Player, say: Callable[[str], None]) -> Iterator[None]:
    """Let the keys of the terminal control a player; without a terminal, or in the background, do nothing.

    The terminal gets its settings back at the end of the block.
    """
    if not (sys.stdin.isatty() and _is_in_foreground(sys.stdin.fileno())):
        yield
        return
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
