"""The streams of a command: their settings in a rig file, their check before any work, and their opening."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import fields, replace
from importlib import import_module
from pathlib import Path
from typing import Protocol

from ipsys_log.capture.lab import OpenLab
from ipsys_log.extras import check_installed
from ipsys_log.messages import RigStream
from ipsys_log.messages.channels import TRACKS
from ipsys_log.sinks.sink import DropReport, InlineSink
from ipsys_log.sinks.streams import STREAMS, StreamSettings
from ipsys_log.sinks.streams.poses import StreamContext, first_session


class Stream(InlineSink, Protocol):
    """A sink with open sockets that never waits; one with connections also has a ``client_count``.

    ``drops`` counts the messages that the stream lost.
    """

    drops: DropReport

    def describe(self) -> str:
        """Return one line about the receivers of the positions."""

    def close(self) -> None:
        """Close the sockets."""


def settings_of_rig(stream: RigStream | None, folder: Path) -> StreamSettings:
    """Return the settings of a rig file; the path of its key is relative to the folder of the file."""
    if stream is None:
        return StreamSettings()
    given = {field.name: getattr(stream, field.name) for field in fields(stream)}
    given["key"] = None if stream.key is None else folder / stream.key
    return StreamSettings(**{name: value for name, value in given.items() if value is not None})


@contextmanager
def open_streams(context: StreamContext) -> Iterator[list[Stream]]:
    """Open streams; their sockets are closed after the block."""
    with ExitStack() as stack:
        streams: list[Stream] = []
        for name in context.settings.wanted:
            if STREAMS[name]:
                check_installed(f"--{name} needs", *STREAMS[name])
            module = import_module(f"ipsys_log.sinks.streams.{name}")
            streams.extend(stack.enter_context(closing(stream)) for stream in module.open_all(context))
        yield streams


def open_live_streams(
    settings: StreamSettings, lab: OpenLab, run: str
) -> AbstractContextManager[list[Stream]]:
    """Open streams of the tracks of a run, for the robots of an open lab."""
    cameras, heights_m = lab.cameras, lab.rig.robot_heights_m()
    now_ns, topics = cameras.clock.now_ns, {TRACKS.topic_of(run)}
    session = first_session(now_ns())
    context = StreamContext(settings, topics, now_ns, cameras.add_event, session, heights_m)
    return open_streams(replace(context, positions=cameras.positions))


def check_streams(settings: StreamSettings) -> list[str]:
    """Open all sockets and close them again; return a line for each stream about its receivers."""
    with open_streams(StreamContext(settings, (), lambda: 0, lambda kind, text: None, 0)) as streams:
        return [stream.describe() for stream in streams]
