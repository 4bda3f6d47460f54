"""A page in a real browser: its requests, its image sizes, and its width."""

import html
import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome")

# A window of headless Chromium is at least 500 px wide; a frame in it can be as narrow as a phone.
_FRAME = """<!doctype html><meta charset="utf-8"><body style="margin:0">
<iframe id="frame" style="border:0;width:{width}px;height:900px" srcdoc="{page}"></iframe>
<script>
window.onload = () => {{
  const frame = document.getElementById("frame"), page = frame.contentDocument;
  for (const part of page.querySelectorAll("details")) part.open = true;
  const found = {{
    width: page.documentElement.scrollWidth,
    images: [...page.images].map(
      i => [i.alt, i.naturalWidth, i.naturalHeight, i.getBoundingClientRect().width]),
    addresses: [...page.querySelectorAll("[src],[href]")].map(
      e => e.getAttribute("src") || e.getAttribute("href")),
    fetched: frame.contentWindow.performance.getEntriesByType("resource").map(e => e.name),
    scripts: page.scripts.length,
    ran: frame.contentWindow.ran === true,
    text: page.body.innerText,
  }};
  const place = document.createElement("pre");
  place.id = "found";
  place.textContent = JSON.stringify(found);
  document.body.append(place);
}};
</script></body>"""


@dataclass(frozen=True)
class Visit:
    """The state of a page: ``width`` in px.

    ``images`` with alt text, natural width and height, and shown width.
    """

    width: int
    images: list[tuple[str, int, int, float]]
    addresses: list[str]
    fetched: list[str]
    scripts: int
    ran: bool
    text: str
    console: list[str]

    @property
    def remote(self) -> list[str]:
        """Return the addresses that are outside the page."""
        return [a for a in (*self.addresses, *self.fetched) if not a.startswith(("#", "data:"))]


def chromium() -> str:
    """Return the path of the browser; skip the test without a browser."""
    found = next((path for name in _NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip("no Chromium to open the page in; on Debian: apt-get install chromium")
    return found


def visit(page: str, width: int, folder: Path) -> Visit:
    """Open a page in a frame of a given width, without a network."""
    frame = folder / f"frame_{width}.html"
    frame.write_text(_FRAME.format(width=width, page=html.escape(page)), encoding="utf-8")
    done = subprocess.run(
        [
            chromium(), "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
            "--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={folder / 'profile'}",
            f"--window-size={max(width, 500)},1000", "--virtual-time-budget=5000", "--dump-dom",
            frame.as_uri(),
        ],
        capture_output=True, text=True, check=True, timeout=240,
    )  # fmt: skip
    match = re.search(r'<pre id="found">(.*?)</pre>', done.stdout, re.DOTALL)
    assert match is not None, done.stderr
    found: dict[str, Any] = json.loads(html.unescape(match[1]))
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return Visit(**{**found, "images": [tuple(image) for image in found["images"]]}, console=console)
