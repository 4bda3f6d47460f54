"""Channels of a log that a pack keeps: recorded ones, and results that cannot be computed again."""

from __future__ import annotations

from glob import escape

from ipsys_log.engine.graph import stage_named
from ipsys_log.engine.provenance import newest_run
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import camera_of_topic, run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Run
from ipsys_log.messages.channels import CHANNELS, MARKERS, MEASUREMENTS, RECORD
from ipsys_log.plain_text import shell_words
from ipsys_log.tools.cut_selection import CutOptions


def kept_channels(session: Session, without_images: bool) -> set[str]:
    """Return the topics of derived channels that a pack keeps.

    Imported runs are kept, because no stage can compute them. Without images, the newest markers are kept.

    Raises
    ------
    IpsysError
        The images are left out, and no markers are detected yet.
    """
    kept = {topic for run in session.runs() if _is_imported(run) for topic in _topics(session, run.run)}
    if session.images and not without_images:
        return kept
    run_name = newest_run(session, MARKERS)
    if run_name is not None:
        kept |= {*session.topics(MARKERS, run_name), RECORD.topic_of(run_name)}
    elif session.images:
        raise IpsysError(
            f"{session}: has no markers, which a pack without images needs; run: "
            f"ipsys replay --until detect {shell_words(*session.paths)}"
        )
    return kept


def _is_imported(run: Run) -> bool:
    return stage_named(run.stage) is None


def _topics(session: Session, run: str) -> set[str]:
    return {topic for reader in session.readers for topic in reader.channels if run_of_topic(topic) == run}


def cut_options(session: Session, kept: set[str], without_images: bool, every: int) -> CutOptions | None:
    """Return the options of the cut of one log; None if nothing of it is kept but its settings.

    Raises
    ------
    IpsysError
        The log has measurements, but no frames or results that are kept.
    """
    topics = {topic for reader in session.readers for topic in reader.channels if session.count(topic)}
    images = set(session.images.values()) if without_images else set()
    runs = {run for topic in topics if (run := run_of_topic(topic)) is not None}
    kept_runs = {run for run in runs if any(run_of_topic(topic) == run for topic in kept & topics)}
    left_out = {topic for topic in topics if run_of_topic(topic) in kept_runs and topic not in kept} | (
        images & topics
    )
    rest = {topic for topic in topics - left_out if run_of_topic(topic) in {None, *kept_runs}}
    if not any(_is_ranged(topic) for topic in rest):
        if MEASUREMENTS.topic in topics:
            raise IpsysError(
                f"{session}: has measurements, but no frames; measure in the log with the frames: "
                "ipsys measure"
            )
        return None
    return CutOptions(
        exclude_topics=[escape(topic) for topic in sorted(left_out)],
        exclude_runs=sorted(runs - kept_runs),
        every=every,
    )


def _is_ranged(topic: str) -> bool:
    """Return whether a topic has messages of instants, and not only settings that hold for the whole log."""
    run, camera = run_of_topic(topic), camera_of_topic(topic)
    return not any(channel.lasting and channel.topic_of(run, camera) == topic for channel in CHANNELS)
