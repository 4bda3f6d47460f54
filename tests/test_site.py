"""The documentation site: complete navigation, sound links, and nothing from other servers.

The same pages are read on GitHub: the links and the structure of the pages are checked for both.
"""

import ast
import re
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

import ipsys_log
from tests.conftest import ROOT
from tests.site_pages import SiteParser, build_site, link_fault, loaded_addresses, parse, read_site, staging
from tests.test_words import texts

PAGES: list[Path] = staging["pages"]()
NOTEBOOKS = {f"docs/{path.stem}.md" for path in (ROOT / "docs").glob("*.ipynb")}
MADE = {"docs/api-reference.md", "schemas/ipsys/v1/README.md", *NOTEBOOKS}
_GITHUB = MarkdownIt("commonmark").enable("table")
# Elements whose number shows a list, table or block of code that Python-Markdown reads in another way.
_ELEMENTS = ("h1", "h2", "h3", "ol", "ul", "li", "table", "tr", "pre", "img")
_FOREIGN = re.compile(r"(?:[a-z]+:)?//", re.IGNORECASE)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_site(tmp_path_factory).resolve()


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, SiteParser]:
    return read_site(site)


def navigation() -> list[str]:
    """Return the pages in the navigation of mkdocs.yml."""
    settings = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    return re.findall(r"(?m)(\S+\.md)$", settings.partition("\nnav:\n")[2])


def test_every_page_is_in_the_navigation_once() -> None:
    names = Counter(navigation())
    assert names == Counter({*(str(path.relative_to(ROOT)) for path in PAGES), *MADE})


def test_pages_load_nothing_from_other_servers(site: Path) -> None:
    files = [path for path in site.rglob("*") if path.suffix in (".html", ".css", ".js")]
    assert len(files) > 40
    foreign = {
        str(path.relative_to(site)): address
        for path in files
        for address in loaded_addresses(path)
        if _FOREIGN.match(address)
    }
    assert foreign == {}


def test_links_and_anchors_of_the_site_resolve(site: Path, pages: dict[Path, SiteParser]) -> None:
    checked = [(path, link) for path, page in pages.items() if path.name != "404.html" for link in page.links]
    assert len(checked) > 1000
    assert [fault for path, link in checked if (fault := link_fault(path, link, site, pages))] == []


def github_anchors(text: str) -> set[str]:
    """Return the anchors that GitHub gives to the headings of a page."""
    anchors: Counter[str] = Counter()
    tokens = _GITHUB.parse(text)
    result = set()
    for token, following in pairwise(tokens):
        if token.type == "heading_open":
            plain = "".join(child.content for child in following.children or () if child.content)
            name = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
            result.add(f"{name}-{anchors[name]}" if anchors[name] else name)
            anchors[name] += 1
    return result


def github_links(text: str) -> list[str]:
    """Return the addresses of links and images on a page, without those in code."""
    children = [child for token in _GITHUB.parse(text) for child in token.children or ()]
    links = [child.attrs.get("href") or child.attrs.get("src") for child in children if child.attrs]
    return [str(link) for link in links if link and not re.match(r"[a-z]+:", str(link))]


def github_faults(page: Path, text: str) -> list[str]:
    """Return the links of a page that lead nowhere on GitHub."""
    faults = []
    for link in github_links(text):
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if target != page and not (target.exists() and target.is_relative_to(ROOT)):
            faults.append(f"{link}: no such file")
            continue
        shown = text if target == page else target.read_text(encoding="utf-8") if anchor else ""
        if anchor and anchor not in github_anchors(shown):
            faults.append(f"{link}: no such heading")
    return faults


def test_links_of_pages_resolve_on_github() -> None:
    faults = {page: github_faults(page, page.read_text(encoding="utf-8")) for page in PAGES}
    assert {page: found for page, found in faults.items() if found} == {}


def counted(parser: SiteParser) -> dict[str, int]:
    return {name: parser.article[name] for name in _ELEMENTS}


def test_pages_have_the_structure_that_github_shows(site: Path, pages: dict[Path, SiteParser]) -> None:
    """A list that Python-Markdown does not see is a paragraph with hyphens."""
    differences: dict[str, tuple[dict[str, int], dict[str, int]]] = {}
    for path in PAGES:
        name = path.relative_to(ROOT)
        source = re.sub(r"(?ms)^```math.*?^```$", "", path.read_text(encoding="utf-8"))
        expected = counted(parse(f"<article>{_GITHUB.render(source)}</article>"))
        built = "index.html" if name == Path("README.md") else name.with_suffix(".html")
        built = str(built).replace("README.html", "index.html")
        shown = counted(pages[site / built])
        differences |= {str(name): (expected, shown)} if expected != shown else {}
    assert differences == {}


@pytest.mark.parametrize(
    ("source", "staged"),
    [
        ("1. a\n   - b\n   - c\n2. d", "1. a\n    - b\n    - c\n2. d"),
        ("text\n- a\n  b", "text\n\n- a\n    b"),
        ("10. a\n\n        code", "10. a\n\n        code"),
        ("- a\n\n      code\n\nb", "- a\n\n        code\n\nb"),
        ("```\n- a\n  - b\n```", "```\n- a\n  - b\n```"),
        ("a\n2024. b", "a\n2024. b"),
    ],
)
def test_lists_get_the_indentation_of_python_markdown(source: str, staged: str) -> None:
    assert staging["indent_lists"](source) == staged


def test_equations_are_mathml_and_not_tex(pages: dict[Path, SiteParser], site: Path) -> None:
    page = (site / "docs" / "equations.html").read_text(encoding="utf-8")
    shown = re.sub(r"(?s)<annotation.*?</annotation>", "", page)
    assert pages[site / "docs" / "equations.html"].article["math"] > 25
    assert [text for text in ("\\frac", "\\sum", "```math", "$`") if text in shown] == []


def test_alignment_of_equations_is_refused() -> None:
    with pytest.raises(SystemExit, match="use a block for each line"):
        staging["draw_equations"]("```math\n\\begin{aligned} a &= b \\end{aligned}\n```")


def test_reference_has_every_public_name(pages: dict[Path, SiteParser], site: Path) -> None:
    anchors = pages[site / "docs" / "api-reference.html"].anchors
    assert [name for name in ipsys_log.__all__ if f"ipsys_log.{name}" not in anchors] == []


@pytest.mark.slow
def test_quoted_errors_are_those_of_the_program() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    rows = page.partition("## Error messages")[2].splitlines()
    quoted = [found[1] for row in rows if (found := re.match(r"\| `([^`]+)` \|", row))]
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "ipsys_log").rglob("*.py")]
    said = [text for source in sources for _, text in texts(ast.parse(source))]
    assert len(quoted) > 5
    assert [quote for quote in quoted if not any(quote in text for text in said)] == []
