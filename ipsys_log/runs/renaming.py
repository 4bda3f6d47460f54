"""Other names of runs: in topics, in the records of runs, and in the frame ids of robots."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any, TypeVar

from ipsys_log.log.contents import run_of_topic
from ipsys_log.messages import Cut, FrameTransforms, MergedLog, Run

Origins = TypeVar("Origins", Cut, MergedLog)


def rename_topic(topic: str, names: Mapping[str, str]) -> str:
    """Return a topic with the new name of its run.

    Examples
    --------
    >>> rename_topic("/runs/poly/tracks", {"poly": "poly_2"})
    '/runs/poly_2/tracks'
    """
    run = run_of_topic(topic)
    if run is None or run not in names:
        return topic
    return topic.replace(f"/runs/{run}/", f"/runs/{names[run]}/", 1)


def rename_frames(payload: Any, names: Mapping[str, str]) -> Any:
    """Return a payload with the new names of runs in the frame ids of robots; other payloads stay."""
    if not isinstance(payload, FrameTransforms):
        return payload
    return FrameTransforms(
        tuple(
            replace(transform, child_frame_id=_rename_frame(transform.child_frame_id, names))
            for transform in payload.transforms
        )
    )


def _rename_frame(frame_id: str, names: Mapping[str, str]) -> str:
    run, slash, robot = frame_id.partition("/")
    return f"{names.get(run, run)}{slash}{robot}"


def rename_channels(record: Origins, names: Mapping[str, str]) -> Origins:
    """Return the record of a cut, or of a log in a merge, with the new names of runs in its channels."""
    channels = tuple(replace(one, topic=rename_topic(one.topic, names)) for one in record.channels)
    return replace(record, channels=channels)


def rename_record(run: Run, names: Mapping[str, str], own: Collection[str]) -> Run:
    """Return the record of a run with the new names of its run and of the runs that it has read.

    Parameters
    ----------
    own : the topics of runs of the same log that it has read. The model of another log has its name there.
    """
    return replace(
        run,
        run=names.get(run.run, run.run),
        input_runs=tuple(names.get(name, name) for name in run.input_runs),
        inputs=tuple(
            replace(read, topic=rename_topic(read.topic, names)) if read.topic in own else read
            for read in run.inputs
        ),
        outputs=tuple(replace(output, topic=rename_topic(output.topic, names)) for output in run.outputs),
    )
