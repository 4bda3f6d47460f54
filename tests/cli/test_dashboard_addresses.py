"""The addresses of a dashboard: on this machine one without a code, in a network two with codes."""

from __future__ import annotations

from threading import Thread

import pytest
from rich.console import Console

from ipsys_log.app.cli import pages
from ipsys_log.app.cli.pages import _print_addresses
from ipsys_log.app.web.server import PageServer, ServerExceptions, qr_code

VIEW, OPERATE = "http://10.0.0.7:8000/?key=abc", "http://10.0.0.7:8000/?key=def"


def printed(
    monkeypatch: pytest.MonkeyPatch, width: int, url: str, view_url: str | None, is_secret: bool
) -> tuple[list[str], list[str]]:
    """Return the lines of the output and those of the remarks."""
    shown, said = Console(width=width, record=True), Console(width=200, record=True)
    monkeypatch.setattr(pages, "console", shown)
    monkeypatch.setattr("ipsys_log.app.cli.console.remarks", said)
    _print_addresses(PageServer(url, Thread(), ServerExceptions(), view_url), is_secret)
    return shown.export_text().splitlines(), said.export_text().splitlines()


def test_address_of_this_machine_has_no_code(monkeypatch: pytest.MonkeyPatch) -> None:
    shown, said = printed(monkeypatch, 80, "http://127.0.0.1:8000/", None, False)
    assert (shown, said) == ([], ["dashboard at http://127.0.0.1:8000/"])


def test_one_secret_has_one_code(monkeypatch: pytest.MonkeyPatch) -> None:
    shown, said = printed(monkeypatch, 80, VIEW, None, True)
    assert shown == qr_code(VIEW).splitlines()
    assert said == [f"dashboard at {VIEW}"]


@pytest.mark.parametrize("width", [60, 80])
def test_two_secrets_have_two_codes_with_their_names(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    shown, said = printed(monkeypatch, width, OPERATE, VIEW, True)
    assert said == [f"dashboard, to view:    {VIEW}", f"dashboard, to operate: {OPERATE}"]
    view, operate = (qr_code(url).splitlines() for url in (VIEW, OPERATE))
    assert max(map(len, shown)) <= width
    if width == 60:  # too narrow for two codes side by side
        assert shown == [*view, "view", *operate, "operate"]
    else:
        assert shown[-1].split() == ["view", "operate"]
        assert all(line.startswith(code) for line, code in zip(shown, view, strict=False))
        assert all(line.endswith(code) for line, code in zip(shown, operate, strict=False))
