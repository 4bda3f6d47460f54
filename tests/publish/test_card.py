"""The dataset card: its form, its errors, and texts that stay texts in Markdown."""

import html
import json
import re
import shutil
import tomllib
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from ipsys_log.errors import IpsysError
from ipsys_log.plain_text import plain_text
from ipsys_log.tools.publish.card import card_form, escape_markdown, read_card
from ipsys_log.tools.publish.packing import pack
from tests.conftest import Ipsys
from tests.publish.packs import CARD, write_card

# Text of the author that would be marks, code, tags, links, tables, headings or lists.
_SIGNS = st.text("ab1 .,`*_~<>&|[](){}#+-=!$:/@\\\"'wW\n\t\x1b\u202e", max_size=40)


def render(text: str) -> str:
    return str(MarkdownIt("gfm-like", {"linkify": False, "html": True}).render(text))


@given(_SIGNS)
@example("[a]: /b")
@example("![a](b) [a](b) <b>")
@example("1. a")
@example("---")
@example("~~a~~ &amp; `b`")
def test_escaped_text_is_shown_as_it_is(text: str) -> None:
    """A Markdown program shows the text, in a paragraph and in the cell of a table."""
    shown = html.escape(plain_text(" ".join(text.split()))).replace("&#x27;", "'")
    paragraph = re.fullmatch(r"(?:<p>(.*)</p>\n)?", render(escape_markdown(text)))
    assert paragraph is not None
    assert (paragraph[1] or "") == shown
    cell = render(f"| a | b |\n| --- | --- |\n| x | {escape_markdown(text)} |\n")
    assert re.findall(r"<td>(.*?)</td>", cell) == ["x", shown]


def test_form_has_every_key_once_and_is_filled(tmp_path: Path, ipsys: Ipsys) -> None:
    form = tmp_path / "card.toml"
    assert ipsys("pack", "--card-form", form).code == 0
    assert form.read_text() == card_form()
    table = tomllib.loads(card_form())
    assert {key for key, value in table.items() if value} == set()
    with pytest.raises(IpsysError, match=r"card.toml: title is empty; write it"):
        read_card(form)
    filled = form.read_text().replace("authors = []", 'authors = ["A"]')
    for number, key in enumerate(table):
        filled = filled.replace(f'\n{key} = ""', f'\n{key} = "text {number}"')
    form.write_text(filled.replace('published = "text 9"', "published = 2026-05-04"))
    card = read_card(form)
    assert card.published == "2026-05-04"
    assert [getattr(card, key) for key in ("title", "licence", "url")] == ["text 0", "text 2", "text 11"]
    done = ipsys("pack", "--card-form", form)
    assert (done.code, "exists already" in done.err) == (1, True)
    assert read_card(form) == card


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (CARD.replace("title", "name"), "'name' is not a key of a card: title, authors"),
        (CARD.replace('"Small lab"', "3"), 'title must be a text in quotes, such as title = "..."'),
        (CARD.replace('["First Author", "Second Author"]', '"One"'), "authors must be a list of names"),
        (CARD.replace('["First Author", "Second Author"]', '[""]'), "authors is empty"),
        (
            CARD.replace("2026-05-04", "May 2026"),
            "published must be a day such as 2026-05-04, not 'May 2026'",
        ),
        (CARD.replace('"Small lab"', '"Small lab'), "is not valid TOML"),
        ("a = " + "[" * 100_000, "is not valid TOML"),
        (CARD + 'place = "' + "x" * 30_000 + '"', "place has more than 20000 characters"),
        ("#" * 2_000_000, "is too large for a card"),
    ],
)
def test_fault_of_a_card_is_one_line(tmp_path: Path, text: str, fault: str) -> None:
    with pytest.raises(IpsysError) as error:
        read_card(write_card(tmp_path / "card.toml", text))
    assert fault in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_card_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(IpsysError, match=r"to write a form: ipsys pack --card-form card.toml"):
        read_card(tmp_path / "card.toml")
    (tmp_path / "latin.toml").write_bytes(b'title = "\xe9"')
    with pytest.raises(IpsysError, match="is not a text file"):
        read_card(tmp_path / "latin.toml")


def test_hostile_texts_are_no_paths_and_no_markdown(packed: Path, tmp_path: Path) -> None:
    log = Path(shutil.copy(packed / "lab.mcap", tmp_path / "..$(x)[y](z) | -rf.mcap"))
    title = "../../<script>alert(1)</script> | [x](javascript:alert(1)) ![y](https://example.org/z.png)"
    text = CARD.replace('"Small lab"', json.dumps(title)).replace("First Author", "# A\\n\\n---\\n* b")
    done = pack([log], tmp_path / "x", write_card(tmp_path / "c.toml", text), models=["rigid"])
    assert "logs/x_y_z_-rf.mcap" in done.files
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([log.name, "c.toml", "x"])
    page = render((tmp_path / "x/README.md").read_text())
    assert re.search("<script|<a |<img|<hr|<li", page) is None
    assert f"<h1>{html.escape(title)}</h1>" in page
    assert "# A --- * b, Second Author" in page
    assert json.loads((tmp_path / "x/croissant.json").read_text())["name"] == title
