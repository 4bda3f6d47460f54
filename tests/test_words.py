"""Docstrings, comments and texts are plain English: no sentence begins with a relative clause."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from ipsys_log.cli.app import app
from tests.conftest import ROOT

# Such a sentence starts without a subject; with a question mark, it is a question.
_OPENING = re.compile(r"(?:^|[.;:!?]\s+)(Who|What|Whether|Where|Of|That which)\b(?![^.]*\?)")
# An error begins with a small letter.
_TEXT_OPENING = re.compile(_OPENING.pattern, re.IGNORECASE)
# Phrases of an earlier dialect; docs/glossary.md has the standard terms.
_PHRASES = (
    "lies still",
    "lie still",
    "lay still",
    "measured place",
    "places held out",
    "how far it is off",
    "of what cameras send",
    "was not looked at",
    "were not looked at",
    "how a camera hangs",
)
_TEXT_PHRASES = (*_PHRASES, "there is no such", "no such camera", "is no number", "anew", "is made first")
# A shorter text is a part of a sentence, such as "of focus".
_FEWEST_WORDS = 4
# Stages write these texts into derived channels: docs/decisions/stage-texts.md. A new text is a new version.
_STAGE_TEXTS: tuple[str, ...] = ()
_FILES = sorted(
    path for folder in ("ipsys_log", "benchmarks", "tests") for path in ROOT.glob(f"{folder}/**/*.py")
)
_SOURCES = [path for path in _FILES if path.is_relative_to(ROOT / "ipsys_log")]


def sentences(source: str) -> Iterator[tuple[int, str]]:
    """Yield the docstrings and comments of a source, each with its line."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "lineno", 1), text
    lines: list[tuple[int, str]] = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            lines.append((token.start[0], token.string.lstrip("# ")))
    for number, (line, text) in enumerate(lines):
        follows = number and lines[number - 1][0] == line - 1
        if not follows:
            yield line, text


def faults(source: str) -> list[str]:
    found = []
    for line, text in sentences(source):
        plain = re.sub(r"``.*?``|>>> .*", "x", text)
        for paragraph in re.split(r"\n\s*\n", plain):
            opening = _OPENING.search(" ".join(paragraph.split()))
            if opening:
                found.append(f"line {line}: begins with {opening[1]!r}: {' '.join(paragraph.split())[:70]}")
        found += [f"line {line}: {phrase!r}" for phrase in _PHRASES if phrase in plain.lower()]
    return found


def texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield the strings of a source that are not docstrings, each with its line; x stands for a value."""
    tree = ast.parse(source)
    skipped: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr):
            skipped.add(id(node.value))
        elif isinstance(node, ast.JoinedStr):
            skipped.update(id(part) for part in node.values if isinstance(part, ast.Constant))
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value
        elif isinstance(node, ast.JoinedStr):
            parts = [str(part.value) if isinstance(part, ast.Constant) else "x" for part in node.values]
            yield node.lineno, "".join(parts)


def text_faults(text: str) -> list[str]:
    """Return the faults of a text for a person: an error, a remark, a help text, a title."""
    if len(text.split()) < _FEWEST_WORDS or text in _STAGE_TEXTS:
        return []
    found = []
    for paragraph in re.split(r"\n\s*\n", text):
        opening = _TEXT_OPENING.search(" ".join(paragraph.split()))
        if opening:
            found.append(f"{opening[1]!r} begins a sentence: {' '.join(paragraph.split())[:90]}")
    return found + [f"{phrase!r}: {text[:90]}" for phrase in _TEXT_PHRASES if phrase in text.lower()]


def help_texts(command: Any, path: str) -> Iterator[tuple[str, str]]:
    """Yield the help of a command, of its options and of its subcommands, each with its name."""
    yield path, command.help or ""
    for parameter in command.params:
        yield f"{path} {parameter.opts[0]}", getattr(parameter, "help", None) or ""
    for name, subcommand in getattr(command, "commands", {}).items():
        yield from help_texts(subcommand, f"{path} {name}")


_HELP = list(help_texts(typer.main.get_command(app), "ipsys"))


@pytest.mark.parametrize("path", _FILES, ids=[str(path.relative_to(ROOT)) for path in _FILES])
def test_docstrings_and_comments_are_plain(path: Path) -> None:
    assert faults(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "source",
    [
        '"""What is recorded."""',
        "x = 1  # Who asks for more has read it.",
        'def f():\n    """Return it. Of these, one is right."""',
        '"""Return where a marker lies still."""',
    ],
)
def test_the_guard_sees_a_fault(source: str) -> None:
    assert faults(source)


def test_questions_and_code_are_no_fault() -> None:
    assert faults('"""Return x. ``What`` is a name. Is it right? What then?"""') == []


_PAGES = sorted(path for suffix in ("html", "js") for path in ROOT.glob(f"ipsys_log/**/*.{suffix}"))
# Phrases of earlier pages. An id or a CSS class may still have them.
_PAGE_PHRASES = (
    *_PHRASES,
    "off by",
    "by how much",
    "has to lie",
    "it says",
    "knows little",
    "the place",
    "places",
    "somebody",
)


def page_texts(source: str, suffix: str) -> list[str]:
    """Return the visible texts of a page: text and labels of HTML, or literals with a space of a script."""
    if suffix == ".js":
        code = re.sub(r"^\s*//.*$", "", source, flags=re.MULTILINE)
        literals = re.findall(r'"((?:[^"\\\n]|\\.)*)"|`((?:[^`\\]|\\.)*)`', code)
        return [text for pair in literals for text in pair if " " in text.strip()]
    plain = re.sub(r"\{%.*?%\}|\{#.*?#\}|<style>.*?</style>", "", source, flags=re.DOTALL)
    plain = re.sub(r"\{\{.*?\}\}", "x", plain, flags=re.DOTALL)
    labels = re.findall(r'(?:aria-label|alt|title|placeholder)="([^"]*)"', plain)
    inline = re.sub(r"</?(?:b|i|em|code|span)\b[^>]*>", "", plain)
    return [text for text in (*re.split(r"<[^>]*>", inline), *labels) if text.strip()]


def page_faults(source: str, suffix: str) -> list[str]:
    """Return the visible texts with a fault."""
    texts = [" ".join(text.split()) for text in page_texts(source, suffix)]
    return [
        text
        for text in texts
        if _OPENING.search(text) or any(phrase in text.lower() for phrase in _PAGE_PHRASES)
    ]


@pytest.mark.parametrize("path", _PAGES, ids=[str(path.relative_to(ROOT)) for path in _PAGES])
def test_pages_are_plain(path: Path) -> None:
    assert page_faults(path.read_text(encoding="utf-8"), path.suffix) == []


def test_comments_of_the_example_rig_are_plain() -> None:
    """The example is the first file that a new user reads."""
    comments = re.findall(r"# .*", (ROOT / "ipsys_log/rig/lab.toml").read_text(encoding="utf-8"))
    text = " ".join(comment.lstrip("# ") for comment in comments)
    assert len(comments) > 40
    assert [phrase for phrase in _PAGE_PHRASES if phrase in text.lower()] == []
    assert _OPENING.search(text) is None


@pytest.mark.parametrize(
    ("source", "suffix"),
    [
        ("<h2>Where not to trust it</h2>", ".html"),
        ("<h1>Positions are off by {{ head.mean }} cm</h1>", ".html"),
        ('<nav aria-label="Places in the log"></nav>', ".html"),
        ('save.textContent = "Wait: the marker has to lie still";', ".js"),
    ],
)
def test_page_guard_finds_a_fault(source: str, suffix: str) -> None:
    assert page_faults(source, suffix)


def test_page_guard_finds_texts_of_every_page() -> None:
    assert len(_PAGES) >= 8
    found = {path.name: page_texts(path.read_text(encoding="utf-8"), path.suffix) for path in _PAGES}
    assert "Measured so far" in found["measure.html"]
    assert "Nothing yet." in found["measure.js"]
    assert "Error map" in found["session.html"]


@pytest.mark.parametrize("path", _SOURCES, ids=[str(path.relative_to(ROOT)) for path in _SOURCES])
def test_texts_for_people_are_plain(path: Path) -> None:
    said = [(line, text_faults(text)) for line, text in texts(path.read_text(encoding="utf-8"))]
    assert [f"line {line}: {fault}" for line, found in said for fault in found] == []


@pytest.mark.parametrize(("name", "text"), _HELP, ids=[name for name, _ in _HELP])
def test_help_is_plain(name: str, text: str) -> None:
    assert text or name.endswith("--help")
    assert text_faults(text) == []


@pytest.mark.parametrize(
    "source",
    [
        'raise IpsysError("what is recorded is not shown")',
        'raise IpsysError(f"{path}: where it is seen, nobody knows")',
        'say(f"{count} frames. Of these, one is right")',
        'say("the camera has gone; plug it in " "anew")',
        'help = "Whether the log is read again."',
    ],
)
def test_the_guard_sees_a_fault_in_a_text(source: str) -> None:
    assert [fault for _, text in texts(source) for fault in text_faults(text)]


def test_a_question_is_no_fault_in_a_text() -> None:
    assert text_faults("Where is the marker now?") == []
