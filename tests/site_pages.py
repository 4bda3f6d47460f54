"""The documentation site: its build, and the references and anchors of its pages."""

import os
import re
import runpy
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass, field
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from tests.conftest import ROOT
from tests.shared_files import make_once

_PACKAGES = ("mkdocs", "material", "mkdocstrings", "latex2mathml")
# Attributes with an address that a browser loads at once; a link in the text loads nothing.
_LOADED = {
    "img": ("src", "srcset"), "script": ("src",), "iframe": ("src",), "source": ("src", "srcset"),
    "video": ("src", "poster"), "audio": ("src",), "embed": ("src",), "object": ("data",), "track": ("src",),
    "image": ("href", "xlink:href"), "use": ("href", "xlink:href"), "input": ("src",),
}  # fmt: skip
_LOADED_LINKS = {
    "stylesheet", "icon", "preload", "prefetch", "preconnect", "dns-prefetch", "modulepreload", "manifest",
    "apple-touch-icon",
}  # fmt: skip
_CSS_ADDRESS = re.compile(r"""url\(\s*['"]?([^'")]+)|@import\s+['"]([^'"]+)""")
_SCRIPT_ADDRESS = re.compile(r"""(?:importScripts|import)\(\s*['"`]([^'"`]+)|\bfrom\s*['"](https?:[^'"]+)""")

staging = runpy.run_path(str(ROOT / "scripts" / "stage-pages"))


@dataclass
class SiteParser(HTMLParser):
    """The loaded addresses, links, anchors and elements of the main text of a page."""

    loaded: list[str] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)
    article: Counter[str] = field(default_factory=Counter)
    _styles: bool = False
    _in_article: bool = False

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        self._styles = tag == "style"
        self._in_article |= tag == "article"
        self.article[tag] += self._in_article
        self.loaded += [values[name].split(" ")[0] for name in _LOADED.get(tag, ()) if values.get(name)]
        self.loaded += css_addresses(values.get("style", ""))
        if tag == "link" and _LOADED_LINKS & set(values.get("rel", "").split()):
            self.loaded.append(values["href"])
        if tag == "a" and "href" in values:
            self.links.append(values["href"])

    def handle_endtag(self, tag: str) -> None:
        self._styles = False
        self._in_article &= tag != "article"

    def handle_data(self, data: str) -> None:
        if self._styles:
            self.loaded += css_addresses(data)


def css_addresses(text: str) -> list[str]:
    """Return the addresses that a style sheet loads."""
    return [first or second for first, second in _CSS_ADDRESS.findall(text)]


def script_addresses(text: str) -> list[str]:
    """Return the modules and workers that a script imports by a constant address."""
    return [first or second for first, second in _SCRIPT_ADDRESS.findall(text)]


def loaded_addresses(path: Path) -> list[str]:
    """Return the addresses that a file of the site loads."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".css":
        return css_addresses(text)
    if path.suffix == ".js":
        return script_addresses(text)
    return parse(text).loaded


def parse(text: str) -> SiteParser:
    """Return the parsed page."""
    parser = SiteParser()
    parser.feed(text)
    return parser


def build_site(factory: pytest.TempPathFactory) -> Path:
    """Build the site once for all workers; skip the test without its packages."""
    missing = [name for name in _PACKAGES if find_spec(name) is None]
    if missing:
        pytest.skip(f"no {', '.join(missing)}: pip install -e '.[dev]'")
    return make_once(factory, "site", _build) / "site"


def _build(folder: Path) -> None:
    pages, config = folder / "pages", ROOT / "mkdocs.yml"
    staging["stage"](pages)
    # The settings of the project, with other folders.
    text = config.read_text(encoding="utf-8")
    text = re.sub(r"(?m)^docs_dir: .*$", f"docs_dir: {pages}", text)
    text = text.replace("paths: [.]", f"paths: [{ROOT}]").replace("[scripts/", f"[{ROOT}/scripts/")
    (folder / "mkdocs.yml").write_text(text, encoding="utf-8")
    # Not --quiet: it also hides the warnings from --strict.
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(folder / "mkdocs.yml")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        [*command, "--site-dir", str(folder / "site")],
        cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def read_site(site: Path) -> dict[Path, SiteParser]:
    """Return the parsed pages of the site by their path."""
    return {path: parse(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}


def link_fault(page: Path, link: str, site: Path, pages: dict[Path, SiteParser]) -> str | None:
    """Return the fault of an internal link, or None."""
    parts = urlsplit(link)
    if parts.scheme or parts.netloc:
        return None
    target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
    if target.is_dir():
        target /= "index.html"
    if not target.is_relative_to(site.resolve()) or not target.is_file():
        return f"{page.relative_to(site)}: {link}: no such file"
    if parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors:
        return f"{page.relative_to(site)}: {link}: no such anchor"
    return None
