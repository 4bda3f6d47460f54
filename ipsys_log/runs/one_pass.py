"""One pass over a log for several stages: causal stages follow the stage whose messages they read.

The first stage works in threads or in processes, so that its followers have the core of this thread. A log
holds its runs one after the other: the run of a stage begins when the run before it is complete. So the
results of the followers wait in a temporary file for their turn. Then they are written as if the stage had
read its input from the log. They are used only if the log has exactly this input by then; otherwise the stage
is computed again.
"""

from __future__ import annotations

import marshal
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import decode, encode, payload_type, schema_name
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Encoded, Event, Message
from ipsys_log.messages.channels import MODEL, RUN_EVENTS, Channel
from ipsys_log.messages.stage import Stage
from ipsys_log.runs.execute import has_given_name
from ipsys_log.runs.graph import Task, copy_model, is_of_model, plan_stage
from ipsys_log.runs.inputs import first_settings, leaves_out_frames
from ipsys_log.runs.options import Progress, Request
from ipsys_log.runs.stream import Route, derive, reader_of, wire

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
        messages, leader, name : the messages of a run, its task and its name. Nothing follows a stage without
            threads.
        stages : the next stages in order. A model that is copied from another log is known before its turn.
            The first stage that cannot follow ends the pass; stages that read the whole log are left out.
        model : the model of the stages.
        """
        # After a stage in Python, reading its results from the log takes less time than keeping those of the
        # next stage.
        if not leader.stage.in_threads:
            yield from messages
            return
        self._forget()
        self._plan(session, leader, name, stages, model)
        for message in messages:
            self._give([message], _Follower.step)
            yield message
        self._give([], _Follower.finish)

    def results(
        self, session: Session, task: Task, name: str, progress: Progress
    ) -> Iterator[Message] | None:
        """Return the results of a task that were computed before its turn; None if there are none."""
        for follower in self._followers:
            if follower.has_done(session, task, name):
                progress(task.stage.name, follower.given, follower.given)
                return follower.results()
        return None

    def _give(
        self, messages: list[Message], take: Callable[[_Follower, Sequence[Message]], list[Message]]
    ) -> None:
        """Give messages of the first stage to those that read them, and their messages to the next ones."""
        made: dict[_Follower | None, list[Message]] = {None: messages}
        for follower in self._followers:
            made[follower] = take(follower, made[follower.before])

    def _plan(
        self, session: Session, leader: Task, name: str, stages: Sequence[Stage], model: str | None
    ) -> None:
        inputs = dict(leader.inputs)
        sources: dict[_Follower | None, _Source] = {None: _Source(leader.stage, name)}
        waiting: set[Channel] = set()
        inputs.update(dict.fromkeys(_own(leader.stage), name))
        for stage in stages:
            if MODEL in stage.writes and self._request.model_from is not None:
                task, payload = copy_model(self._request, str(model))
                run = self._name(session, task, name)
                topic, start_ns = MODEL.topic_of(str(run)), session.start_ns
                session = session.with_message(Message(topic, start_ns, payload.timestamp, payload))
            elif not stage.causal:
                waiting |= _own(stage)
                continue
            elif waiting & set(stage.reads):
                return
            else:
                planned = self._task(session, stage, inputs, model if is_of_model(stage) else None)
                run = self._name(session, planned, name) if planned is not None else None
                read = [key for key, source in sources.items() if planned and source.is_read_by(planned)]
                if planned is None or run is None or len(read) != 1:
                    return
                follower = _Follower(session, planned, run, read[0], sources[read[0]])
                self._followers.append(follower)
                sources[follower] = _Source(stage, run)
            if run is None:
                return
            inputs.update(dict.fromkeys(_own(stage), run))

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


def _own(stage: Stage) -> set[Channel]:
    return set(stage.writes) - {RUN_EVENTS}


@dataclass(frozen=True, slots=True)
class _Source:
    """A stage of the pass, and its run."""

    stage: Stage
    run: str

    def is_read_by(self, task: Task) -> bool:
        return any(task.inputs.get(channel) == self.run for channel in _own(self.stage))

    def topics(self, session: Session) -> set[str]:
        return {topic for channel in self.stage.writes for topic in session.topics(channel, self.run)}

    def others(self, session: Session, task: Task) -> dict[str, tuple[int, list[bytes]]]:
        """Return the topics that a task reads from the log: their counts, and the content of a model."""
        made, models = self.topics(session), session.topics(MODEL, task.inputs.get(MODEL))
        return {
            topic: (
                session.count(topic),
                [encode(payload) for payload in session.payloads([topic])] if topic in models else [],
            )
            for topic in task.topics
            if topic not in made
        }


class _Follower:
    """A causal stage that gets the messages of a stage before it, and those of topics in the log.

    ``before`` is the stage that it follows; None for the first stage of the pass. ``given`` is the number of
    messages that it got.
    """

    def __init__(
        self, session: Session, task: Task, name: str, before: _Follower | None, source: _Source
    ) -> None:
        assert task.step is not None
        self.before = before
        self._task, self._name, self._source = task, name, source
        self._wired = wire(task.stage, name, task.inputs, task.step(name))
        self._payloads_of = reader_of(self._wired)
        routes = {Route(channel, source.run) for channel in source.stage.writes} & self._wired.reads
        self._types = {payload for route in routes for payload in route.channel.payloads}
        self._others = source.others(session, task)
        self.given = 0
        self._has_failed = self._is_complete = False
        self._file = tempfile.SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115
        self._settings = first_settings(session, task, self._others)
        self._recorded = session.messages(self._others)
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
                    self.given += 1
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
        mine, source = self._task, self._source
        if not self._is_complete or (task.stage, name) != (mine.stage, self._name):
            return False
        made = source.topics(session).intersection(task.topics)
        return (
            _settings_of(task) == _settings_of(mine)
            and source.others(session, task) == self._others
            and sum(session.count(topic) for topic in made) == self.given
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
        return list(derive(self._wired, message, self._payloads_of(message)))

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
