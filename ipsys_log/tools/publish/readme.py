"""The dataset card of a pack: ``README.md`` with the texts of the author, the content and the scores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

from ipsys_log.engine.view import LogView
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Rig
from ipsys_log.statistics.calibration_points import measured
from ipsys_log.tools.publish.card import Card, escape_markdown
from ipsys_log.tools.publish.members import LOGS, RIG_FILE, SCORES
from ipsys_log.tools.publish.scores import Score
from ipsys_log.units import NS_PER_S, format_bytes, format_time

_CARD_ROWS: dict[str, Callable[[Card], str]] = {
    "Authors": lambda card: ", ".join(card.authors),
    "Licence": lambda card: card.licence,
    "Version": lambda card: card.version,
    "Published": lambda card: card.published,
    "Place": lambda card: card.place,
    "Hardware": lambda card: card.hardware,
    "Marker sizes": lambda card: card.marker_sizes,
    "Measurement": lambda card: card.measured,
    "To cite": lambda card: card.citation,
    "Web address": lambda card: card.url,
}
_SCHEMES = {"cross_validation": "cross-validated", "held_out": "held-out points"}
_REFERENCES = {"tape": "tape", "truth": "ground truth"}


def readme_text(
    card: Card, session: Session, rig: Rig, scores: Sequence[Score], blurred: bool = False
) -> str:
    """Return the dataset card in Markdown.

    All texts of the author and all names from the logs are escaped.

    Parameters
    ----------
    session : the packed logs.
    rig : the newest rig of the logs.
    blurred : True if the images are blurred outside of the markers.
    """
    lines = [f"# {escape_markdown(card.title)}", ""]
    if card.description:
        lines += [escape_markdown(card.description), ""]
    texts = ((name, escape_markdown(text_of(card))) for name, text_of in _CARD_ROWS.items())
    lines += _table(("", ""), ((name, text) for name, text in texts if text))
    lines += ["", "## Content", "", *_table(("file", "size", "messages", "start (UTC)"), _log_rows(session))]
    lines += ["", *_facts(session, rig, blurred)]
    lines += ["", "## Expected scores", "", *_score_lines(scores)]
    lines += ["", "## Check of the scores", "", *_CHECK]
    return "\n".join(lines) + "\n"


_CHECK = (
    "    ipsys score .",
    "",
    "The command checks all files, runs the pipeline again in a temporary copy, and compares the scores. For",
    "your own model, a class with `fit(points_m, world_m)` and `predict(points_m)`:",
    "",
    "    ipsys score . --model mine.py:Estimator",
)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table; the cells are Markdown."""
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]


def _log_rows(session: Session) -> Iterator[tuple[str, str, str, str]]:
    for reader in session.readers:
        start = "" if reader.start_ns is None else format_time(reader.start_ns)
        size = format_bytes(reader.size)
        yield f"{LOGS}/{reader.path.name}", size, str(reader.message_count), start


def _facts(session: Session, rig: Rig, blurred: bool) -> list[str]:
    """Return what the logs and their rig contain."""
    seconds = (session.end_ns - session.start_ns) / NS_PER_S
    cameras = sorted({*session.images, *session.calibrations, *(camera.name for camera in rig.cameras)})
    lengths = sorted({rig.marker_length_m, *(rig.length_of(marker.id) for marker in rig.markers)})
    rows = (
        ("Duration", f"{seconds:.0f} s"),
        ("Cameras", ", ".join(cameras)),
        ("Images", _describe_images(bool(session.images), blurred)),
        ("Calibration points", str(len(measured(LogView(session))))),
        ("Marker dictionary", rig.dictionary),
        ("Marker side", ", ".join(f"{length_m * 100:g} cm" for length_m in lengths)),
    )
    lines = _table(("", ""), ((name, escape_markdown(text)) for name, text in rows))
    return [*lines, "", f"`{RIG_FILE}` is the rig. The logs contain it too."]


def _describe_images(present: bool, blurred: bool) -> str:
    if not present:
        return "no, only detected markers or camera points"
    return "blurred outside of the markers, in grey" if blurred else "yes"


def _score_lines(scores: Sequence[Score]) -> list[str]:
    rows = (
        (
            escape_markdown(score.model),
            f"{_SCHEMES.get(score.scheme, score.scheme)}, {score.dimensions.upper()}",
            _REFERENCES.get(score.against, score.against),
            str(score.points),
            *(f"{value_mm:.3f}" for value_mm in score.figures),
        )
        for score in scores
    )
    head = ("model", "errors", "against", "points", "mean", "median", "p95", "RMSE")
    return [
        f"In mm, over all cameras. `{SCORES}` has all digits, and the tolerances.",
        "",
        *_table(head, rows),
    ]
