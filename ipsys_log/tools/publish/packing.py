"""Packing of logs: a folder or a zip archive with logs, rig, card (README), checksums and expected scores."""

import secrets
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from ipsys_log.engine.request import Progress
from ipsys_log.engine.view import LogView
from ipsys_log.errors import IpsysError
from ipsys_log.log.atomic_files import replacement_of
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Rig
from ipsys_log.messages.channels import RIG
from ipsys_log.messages.rig_file import hide_passwords, rig_toml
from ipsys_log.statistics.calibration_points import measured
from ipsys_log.tools.cut import cut
from ipsys_log.tools.publish.card import Card, escape_markdown, read_card
from ipsys_log.tools.publish.kept_contents import blur_log, cut_options, kept_channels, marker_corners
from ipsys_log.tools.publish.manifest import (
    CHECKSUMS,
    LOGS,
    MANIFEST,
    README,
    RIG_FILE,
    SCORES,
    Member,
    build_manifest,
    check_unique,
    checksum_lines,
    describe_member,
    free_member_name,
    json_text,
)
from ipsys_log.tools.publish.scores import SCORE_FIELDS, Score, compute_scores, scores_json
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


# Times of members in an archive; with the clock of the machine, equal packs would differ.
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class PackResult:
    """A pack that was written: its path, its size in bytes, its files and its expected scores."""

    path: Path
    size: int
    files: tuple[str, ...]
    scores: tuple[Score, ...]


def pack(
    paths: Sequence[Path],
    output: Path,
    card: Path,
    *,
    models: Sequence[str] = (),
    without_images: bool = False,
    blur: bool = False,
    every: int = 1,
    progress: Progress = lambda stage, done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> PackResult:
    """Write logs as a dataset: a folder, or a zip archive if the name of ``output`` ends in ``.zip``.

    The pack has the recorded channels of the logs; results that the pipeline can compute again are left out.
    The expected scores are those of the packed logs. The pack gets its name when it is complete.

    Parameters
    ----------
    paths : the logs, read as one session; they stay unchanged.
    card : the filled form of the dataset card.
    models : names of the models to score; none: all that the logs allow.
    without_images : leave out the images, and keep the detected markers instead.
    blur : blur the images outside of the detected markers, as a new recording in grey.
    every : keep each n-th frame of each camera.

    Raises
    ------
    IpsysError
        The output exists, the card has a fault, or no model can be evaluated on the logs.
    """
    if blur and without_images:
        raise IpsysError("--blur and --without-images cannot be used together; leave out one")
    _check_output(output)
    author = read_card(card)
    with _work_folder(output) as folder:
        logs = _cut_logs(paths, folder, without_images, every, progress, say)
        if blur:
            _blur_logs(paths, logs, progress)
        with tempfile.TemporaryDirectory(prefix="ipsys_pack_") as other:
            scores = compute_scores(logs, Path(other) / "results.mcap", models, progress, say)
        if not scores:
            raise IpsysError(
                f"{', '.join(map(str, paths))}: no model can be evaluated: a pack needs calibration points "
                "in the logs; add them with ipsys measure"
            )
        members = _write_texts(folder, logs, author, scores, blur)
        size = sum(member.size for member in members)
        if output.suffix.lower() == ".zip":
            size = _write_zip(folder, members, output)
        else:
            _give_name(folder, output)
    return PackResult(output, size, tuple(member.name for member in members), tuple(scores))


def _check_output(output: Path) -> None:
    if output.exists() or output.is_symlink():
        raise IpsysError(f"-o {output}: exists already; choose another name")
    if not output.parent.is_dir():
        raise IpsysError(f"-o {output}: the folder {output.parent} does not exist; create it")


@contextmanager
def _work_folder(output: Path) -> Iterator[Path]:
    """Yield a new folder beside the output, which is removed at the end if it still has its name."""
    folder = output.with_name(f".{output.name}.{secrets.token_hex(4)}.partial")
    try:
        folder.mkdir()
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _cut_logs(
    paths: Sequence[Path],
    folder: Path,
    without_images: bool,
    every: int,
    progress: Progress,
    say: Callable[[str], None],
) -> list[Path]:
    """Write the recorded part of each log; return the new logs."""
    (folder / LOGS).mkdir()
    with Session(paths) as session:
        kept = kept_channels(session, without_images)
    names: list[str] = []
    for path in paths:
        with Session([path]) as session:
            options = cut_options(session, kept, without_images, every)
        if options is None:
            say(f"{path}: is left out, because it has no recorded messages")
            continue
        names.append(free_member_name(path.stem, names))
        cut([path], folder / names[-1], options, progress=progress)
    if not names:
        raise IpsysError(f"{', '.join(map(str, paths))}: no recorded messages; give a log with frames")
    return [folder / name for name in names]


def _blur_logs(paths: Sequence[Path], logs: Sequence[Path], progress: Progress) -> None:
    """Replace each new log by one with blurred images."""
    with Session(paths) as session:
        corners = marker_corners(session)
    for log in logs:
        sharp = log.with_suffix(".sharp")
        log.rename(sharp)
        blur_log(sharp, log, corners, progress)
        sharp.unlink()


def _write_texts(
    folder: Path, logs: Sequence[Path], card: Card, scores: Sequence[Score], blurred: bool
) -> list[Member]:
    """Write all files beside the logs; return all files of the pack, with manifest and checksums."""
    with Session(logs) as session:
        rig, width_px = _newest_rig(session), _image_width(session)
        day = datetime.fromtimestamp(session.end_ns // NS_PER_S, UTC).date().isoformat()
        facts = readme_text(card, session, rig, scores, blurred)
    log_names = [f"{LOGS}/{log.name}" for log in logs]
    texts = {
        README: facts,
        RIG_FILE: rig_toml(rig),
        SCORES: json_text(scores_json(scores, width_px)),
    }
    _write(folder, texts)
    members = [describe_member(folder, name) for name in (*texts, *log_names)]
    manifest = build_manifest(card, card.published or day, members, SCORE_FIELDS)
    _write(folder, {MANIFEST: json_text(manifest)})
    members.append(describe_member(folder, MANIFEST))
    _write(folder, {CHECKSUMS: checksum_lines(members)})
    members.append(describe_member(folder, CHECKSUMS))
    check_unique((member.name for member in members), str(folder))
    return members


def _image_width(session: Session) -> int | None:
    """Return the width of the narrowest images, from the intrinsics; None without images."""
    lenses = (session.payloads([session.calibrations[camera]])[-1] for camera in session.images)
    return min((lens.width for lens in lenses), default=None)


def _newest_rig(session: Session) -> Rig:
    rigs: list[Rig] = session.payloads(session.topics(RIG))
    if not rigs:
        raise IpsysError(f"{session}: has no rig, which a pack needs; import or record the log with a rig")
    return hide_passwords(rigs[-1])


def _write(folder: Path, texts: Mapping[str, str]) -> None:
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")


def _give_name(folder: Path, output: Path) -> None:
    try:
        folder.rename(output)
    except OSError as error:
        raise IpsysError(f"-o {output}: cannot be written: {error.strerror}; choose another name") from error


def _write_zip(folder: Path, members: Iterable[Member], output: Path) -> int:
    """Write an archive; return its size in bytes. Logs are stored: their chunks are compressed already."""
    with replacement_of(output) as file, zipfile.ZipFile(file, "w") as archive:
        for member in members:
            entry = zipfile.ZipInfo(member.name, _ZIP_TIME)
            entry.external_attr = 0o100644 << 16
            is_log = member.name.endswith(".mcap")
            entry.compress_type = zipfile.ZIP_STORED if is_log else zipfile.ZIP_DEFLATED
            entry.file_size = member.size
            with (folder / member.name).open("rb") as source, archive.open(entry, "w") as target:
                shutil.copyfileobj(source, target, 1 << 20)
    return output.stat().st_size
