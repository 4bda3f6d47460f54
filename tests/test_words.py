"""Docstrings, comments and texts are plain English: no sentence begins with a relative clause."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from ipsys_log.app.cli.app import app
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
# A shorter text is a part of a sentence, such as "of focus".
_FEWEST_WORDS = 4
_PACKAGE = ROOT / "ipsys_log"
# Each of them is one test: the folders of the package, its modules, the tests, and the benchmarks.
_FOLDERS = [
    *(path for path in sorted(_PACKAGE.iterdir()) if path.is_dir() and path.name != "__pycache__"),
    _PACKAGE,
    ROOT / "tests",
    ROOT / "benchmarks",
]


def files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.py") if folder == _PACKAGE else folder.rglob("*.py"))


def sentences(source: str, tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the docstrings and comments of a source, each with its line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "lineno", 1), text
    comments = [
        (token.start[0], token.string.lstrip("# "))
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    ]
    lines = {line for line, _ in comments}
    yield from ((line, text) for line, text in comments if line - 1 not in lines)


def texts(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the strings of a source that are not docstrings, each with its line; x stands for a value."""
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


def faults(text: str, opening: re.Pattern[str], phrases: tuple[str, ...]) -> list[str]:
    """Return the paragraphs of a text that begin with a relative clause, and the phrases in it."""
    paragraphs = [" ".join(paragraph.split()) for paragraph in re.split(r"\n\s*\n", text)]
    found = [f"{match[1]!r}: {part[:90]}" for part in paragraphs if (match := opening.search(part))]
    return found + [f"{phrase!r}: {text[:90]}" for phrase in phrases if phrase in text.lower()]


def text_faults(text: str) -> list[str]:
    """Return the faults of a text for a person: an error, a remark, a help text, a title."""
    return faults(text, _TEXT_OPENING, _TEXT_PHRASES) if len(text.split()) >= _FEWEST_WORDS else []


def source_faults(path: Path) -> Iterator[str]:
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    for line, text in sentences(source, tree):
        plain = re.sub(r"``.*?``|>>> .*", "x", text)
        yield from (f"{path}:{line}: {fault}" for fault in faults(plain, _OPENING, _PHRASES))
    if path.is_relative_to(_PACKAGE):
        for line, text in texts(tree):
            yield from (f"{path}:{line}: {fault}" for fault in text_faults(text))


@pytest.mark.parametrize("folder", _FOLDERS, ids=[path.name for path in _FOLDERS])
def test_sentences_of_sources_are_plain(folder: Path) -> None:
    assert [fault for path in files(folder) for fault in source_faults(path)] == []


def test_faults_of_a_source_are_seen(tmp_path: Path) -> None:
    path = tmp_path / "a.py"
    path.write_text(
        '"""What is recorded."""\n# Who asks for more has read it.\n# Is it right? What then?\n'
        'def f():\n    """Return it. Of these, one is right."""\n'
    )
    assert len([*source_faults(path)]) == 3
    assert text_faults("the camera has gone; plug it in anew")
    assert text_faults("x: where it is seen, nobody knows")
    assert not text_faults("Where is the marker now?")
    assert page_faults("<h1>Positions are off by {{ head.mean }} cm</h1>", ".html")
    assert page_faults('save.textContent = "Wait: the marker has to lie still";', ".js")


def page_faults(source: str, suffix: str) -> list[str]:
    """Return the visible texts of a page with a fault: texts and labels, or literals of a script."""
    if suffix == ".js":
        code = re.sub(r"^\s*//.*$", "", source, flags=re.MULTILINE)
        literals = re.findall(r'"((?:[^"\\\n]|\\.)*)"|`((?:[^`\\]|\\.)*)`', code)
        visible = [text for pair in literals for text in pair if " " in text.strip()]
    else:
        plain = re.sub(r"\{%.*?%\}|\{#.*?#\}|<style>.*?</style>", "", source, flags=re.DOTALL)
        plain = re.sub(r"\{\{.*?\}\}", "x", plain, flags=re.DOTALL)
        labels = re.findall(r'(?:aria-label|alt|title|placeholder)="([^"]*)"', plain)
        inline = re.sub(r"</?(?:b|i|em|code|span)\b[^>]*>", "", plain)
        visible = [*re.split(r"<[^>]*>", inline), *labels]
    return [fault for text in visible for fault in faults(text, _OPENING, _PAGE_PHRASES)]


def test_pages_are_plain() -> None:
    pages = [path for suffix in ("html", "js") for path in _PACKAGE.rglob(f"*.{suffix}")]
    assert len(pages) >= 8
    wrong = {path.name: page_faults(path.read_text(encoding="utf-8"), path.suffix) for path in pages}
    assert {name: found for name, found in wrong.items() if found} == {}


def test_comments_of_the_example_rig_are_plain() -> None:
    """The example is the first file that a new user reads."""
    comments = re.findall(r"# .*", (_PACKAGE / "messages/lab.toml").read_text(encoding="utf-8"))
    assert len(comments) > 40
    assert faults(" ".join(comment.lstrip("# ") for comment in comments), _OPENING, _PAGE_PHRASES) == []


def help_texts(command: Any, path: str) -> Iterator[tuple[str, str]]:
    """Yield the help of a command, of its options and of its subcommands, each with its name."""
    yield path, command.help or ""
    for parameter in command.params:
        yield f"{path} {parameter.opts[0]}", getattr(parameter, "help", None) or ""
    for name, subcommand in getattr(command, "commands", {}).items():
        yield from help_texts(subcommand, f"{path} {name}")


def test_help_is_plain() -> None:
    helps = list(help_texts(typer.main.get_command(app), "ipsys"))
    assert [name for name, text in helps if not text and not name.endswith("--help")] == []
    assert {name: text_faults(text) for name, text in helps if text_faults(text)} == {}
