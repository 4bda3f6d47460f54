"""One pass over a log for several stages: causal stages follow the stage whose messages they read.

A log holds its runs one after the other: the run of a stage begins when the run before it is complete. So
the results of the stages that follow wait in a temporary file for their turn. Then they are written as if the
stage had read its input from the log. They are used only if the log has exactly this input by then; otherwise
the stage is computed again.
"""

from __future__ import annotations

import marshal
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import decode, encode, payload_type, schema_name
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Encoded, Event, Message
from ipsys_log.messages.channels import RUN_EVENTS, Channel
from ipsys_log.messages.stage import Stage
from ipsys_log.runs.execute import has_given_name
from ipsys_log.runs.graph import Task, plan_stage
from ipsys_log.runs.inputs import first_settings, leaves_out_frames
from ipsys_log.runs.options import Progress, Request
from ipsys_log.runs.stream import Route, run, wire

__all__ = ["OnePass"]

# Results of one stage in memory, in bytes; more go to the disk.
_IN_MEMORY = 32 << 20
_SIZE_BYTES = 4  # of the length before each result


class OnePass:
    """Stages that follow another one, and their results up to their turn. A context manager.

    Parameters
    ----------
    request : the options of the stages.
    until : the last stage of the command.
    """

    def __init__(self, request: Request, until: Stage) -> None:
        self._request, self._until = request, until
        self._followers: list[_Follower] = []

    def __enter__(self) -> OnePass:
        return self

    def __exit__(self, *_: object) -> None:
        self._forget()

    def follow(
        self,
        messages: Iterable[Message],
        session: Session,
        leader: Task,
        name: str,
        stages: Sequence[Stage],
        model: str | None = None,
    ) -> Iterator[Message]:
        """Yield the messages of a run, and give them to the stages that follow.

        Parameters
        ----------
        messages, leader, name : the messages of a run, its task and its name.
        stages : the next stages in order. The first one that is not causal, or that does not read the stage
            before it, ends the pass.
        model : the model of the stages.
        """
        self._forget()
        if leader.step is not None:
            self._plan(session, leader, name, stages, model)
        for message in messages:
            given = [message]
            for follower in self._followers:
                given = follower.step(given)
            yield message
        given = []
        for follower in self._followers:
            given = follower.finish(given)

    def results(
        self, session: Session, task: Task, name: str, progress: Progress
    ) -> Iterator[Message] | None:
        """Return the results of a task that were computed before its turn; None if there are none."""
        for follower in self._followers:
            if follower.has_done(session, task, name):
                progress(task.stage.name, 0, None)
                return follower.results()
        return None

    def _plan(
        self, session: Session, leader: Task, name: str, stages: Sequence[Stage], model: str | None
    ) -> None:
        inputs = dict(leader.inputs)
        before, run_before = leader.stage, name
        for stage in stages:
            written = {channel: run_before for channel in before.writes if channel is not RUN_EVENTS}
            inputs.update(written)
            task = self._task(session, stage, inputs, model)
            name_next = self._name(session, task, name) if task is not None else None
            if task is None or name_next is None or not written.keys() & task.inputs.keys():
                return
            self._followers.append(_Follower(session, task, name_next, before, run_before))
            before, run_before = stage, name_next

    def _task(
        self, session: Session, stage: Stage, inputs: Mapping[Channel, str], model: str | None
    ) -> Task | None:
        """Return the task of a stage that can follow; None if the stage must wait for the log."""
        request = self._request
        try:
            task = plan_stage(stage, session, request.options(model), inputs, request.rig, request.lenses)
        except IpsysError:  # the stage itself reports it at its turn
            return None
        if isinstance(task, str) or task.step is None or leaves_out_frames(task):
            return None
        return task

    def _name(self, session: Session, task: Task, leader: str) -> str | None:
        """Return the name that a run will have; None if it depends on the runs in the log."""
        if has_given_name(task.stage, self._until) and self._request.run is not None:
            return self._request.run
        return task.run if task.run == leader or task.run not in session.run_names() else None

    def _forget(self) -> None:
        while self._followers:
            self._followers.pop().close()


@dataclass(frozen=True, slots=True)
class _Source:
    """The input of a stage that follows: recorded topics with their counts, and the run before it."""

    counts: Mapping[str, int]
    stage: Stage
    run: str

    @classmethod
    def of(cls, session: Session, task: Task, stage: Stage, run: str) -> _Source:
        made = {topic for channel in stage.writes for topic in session.topics(channel, run)}
        recorded = [topic for topic in task.topics if topic not in made]
        return cls({topic: session.count(topic) for topic in recorded}, stage, run)


class _Follower:
    """A causal stage that gets the messages of the stage before it, and those of its recorded topics."""

    def __init__(self, session: Session, task: Task, name: str, before: Stage, run_before: str) -> None:
        assert task.step is not None
        self._task, self._name = task, name
        self._wired = wire(task.stage, name, task.inputs, task.step(name))
        self._source = _Source.of(session, task, before, run_before)
        self._routes = {Route(channel, run_before) for channel in before.writes} & self._wired.reads
        self._types = {payload for route in self._routes for payload in route.channel.payloads}
        self._given = 0
        self._has_failed = self._is_complete = False
        self._file = tempfile.SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115
        topics = list(self._source.counts)
        self._settings = first_settings(session, task, topics)
        self._recorded = session.messages(topics)
        self._next = next(self._recorded, None)

    def step(self, messages: Sequence[Message], is_last: bool = False) -> list[Message]:
        """Return the messages that the stage makes from those of the stage before it."""
        made: list[Message] = []
        if self._has_failed:
            return made
        try:
            for message in messages:
                if type(message.payload) in self._types:
                    made += self._until(message.log_time_ns)
                    self._given += 1
                    made += self._derive(message)
            if is_last:
                made += self._until(None)
            self._keep(made)
        except Exception:  # at its turn, the stage is computed from the log and raises the error itself
            self._has_failed = True
            return []
        return made

    def finish(self, messages: Sequence[Message]) -> list[Message]:
        """Return the last messages of the stage; the run before is then complete."""
        made = self.step(messages, is_last=True)
        self._is_complete = not self._has_failed
        return made

    def has_done(self, session: Session, task: Task, name: str) -> bool:
        """Return whether the results are those of a task: the same stage with the same input."""
        mine, before = self._task, self._source
        if not self._is_complete or (task.stage, name) != (mine.stage, self._name):
            return False
        made = {topic for channel in before.stage.writes for topic in session.topics(channel, before.run)}
        return (
            _settings_of(task) == _settings_of(mine)
            and _Source.of(session, task, before.stage, before.run).counts == before.counts
            and sum(session.count(topic) for topic in made.intersection(task.topics)) == self._given
        )

    def results(self) -> Iterator[Message]:
        """Yield the messages of the run; their payloads stay encoded, but not those of events."""
        self._file.seek(0)
        while size := self._file.read(_SIZE_BYTES):
            row = self._file.read(int.from_bytes(size, "little"))
            topic, log_ns, publish_ns, camera, schema, data = marshal.loads(row)
            kind = payload_type(schema)
            assert kind is not None
            payload = decode(schema, data) if kind is Event else Encoded(kind, data)
            yield Message(topic, log_ns, publish_ns, payload, camera)

    def close(self) -> None:
        self._file.close()

    def _until(self, log_time_ns: int | None) -> Iterator[Message]:
        """Yield what the stage makes from recorded messages up to a log time; None: from all."""
        for message in self._settings:
            yield from self._derive(message)
        self._settings = iter(())
        while self._next is not None and (log_time_ns is None or self._next.log_time_ns <= log_time_ns):
            yield from self._derive(self._next)
            self._next = next(self._recorded, None)

    def _derive(self, message: Message) -> list[Message]:
        _, *made = run((message,), (self._wired,))
        return made

    def _keep(self, messages: Iterable[Message]) -> None:
        for message in messages:
            times_ns = message.log_time_ns, message.publish_time_ns
            schema, data = schema_name(type(message.payload)), encode(message.payload)
            row = marshal.dumps((message.topic, *times_ns, message.camera, schema, data))
            self._file.write(len(row).to_bytes(_SIZE_BYTES, "little") + row)


def _settings_of(task: Task) -> tuple[object, ...]:
    """Return everything but the topics on which the result of a task depends."""
    lenses = {camera: id(lens) for camera, lens in task.lenses.items()}
    return dict(task.parameters), dict(task.inputs), id(task.rig), lenses
