"""A browser opens every page of the site, and asks no other server for anything.

The server of the test sends a content security policy. So the browser reports each foreign request of a page,
of a style sheet, of a script and of a worker, and does not send it.
"""

import json
import queue
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from tests.report.browser import chromium
from tests.site_pages import build_site

_POLICY = "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; report-uri /report"
_PATIENCE_S = 600
# The harness opens one page after the other in a frame, and then the page with a foreign picture.
_HARNESS = """<!doctype html><meta charset="utf-8"><iframe id="frame" width="1200" height="900"></iframe>
<script>
const pages = %s, frame = document.getElementById("frame");
const open = page => new Promise(done => { frame.onload = () => setTimeout(done, 50); frame.src = page; });
(async () => {
  for (const page of pages) await open(page);
  await fetch("/visited");
  await open("/control.html");
})();
</script>"""
_CONTROL = '<!doctype html><img src="https://example.org/control.png">'


class Site(SimpleHTTPRequestHandler):
    """The site with its policy; requests and reports go into a queue."""

    events: queue.Queue[tuple[str, str]]
    made: dict[str, str]

    def end_headers(self) -> None:
        self.send_header("Content-Security-Policy", _POLICY)
        super().end_headers()

    def do_GET(self) -> None:
        self.events.put(("request", self.path))
        if self.path not in self.made:
            super().do_GET()
            return
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.end_headers()
        self.wfile.write(self.made[self.path].encode())

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.events.put(("report", json.loads(body)["csp-report"]["blocked-uri"]))
        self.send_response(204)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""


@contextmanager
def served(site: Path, made: dict[str, str]) -> Iterator[tuple[str, queue.Queue[tuple[str, str]]]]:
    """Serve the site on loopback; yield its address and its events."""
    events: queue.Queue[tuple[str, str]] = queue.Queue()
    handler = type("Served", (Site,), {"events": events, "made": made})
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=str(site)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", events
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def visit_pages(site: Path, names: list[str], profile: Path) -> list[tuple[str, str]]:
    """Open the pages in a browser; return requests and reports, up to the report of the control page."""
    made = {"/harness.html": _HARNESS % json.dumps(names), "/control.html": _CONTROL, "/visited": "yes"}
    with served(site, made) as (address, events):
        browser = subprocess.Popen(
            [
                chromium(), "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run",
                "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", f"--user-data-dir={profile}",
                "--remote-debugging-port=0", f"{address}/harness.html",
            ],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            seen = [events.get(timeout=_PATIENCE_S)]
            while seen[-1] != ("report", "https://example.org/control.png"):
                seen.append(events.get(timeout=_PATIENCE_S))
        finally:
            browser.terminate()
            browser.wait()
    return seen[:-1]


@pytest.mark.slow
def test_browser_asks_no_other_server(tmp_path_factory: pytest.TempPathFactory, tmp_path: Path) -> None:
    site = build_site(tmp_path_factory)
    names = [f"/{path.relative_to(site)}" for path in sorted(site.rglob("*.html"))]
    seen = visit_pages(site, names, tmp_path / "profile")
    assert [name for name in [*names, "/visited"] if ("request", name) not in seen] == []
    # The index of the search: the scripts of the pages ran.
    assert ("request", "/search/search_index.json") in seen
    assert [address for kind, address in seen if kind == "report"] == []
