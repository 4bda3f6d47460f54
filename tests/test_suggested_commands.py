"""Commands that messages suggest can be pasted into a shell: names of files in them are quoted."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.log.reader import LogReader
from ipsys_log.plain_text import shell_words


def test_suggested_command_has_the_name_as_one_word(tmp_path: Path) -> None:
    log = tmp_path / "a b.mcap"
    log.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(IpsysError, match=re.escape(f"ipsys repair '{log}'")):
        LogReader(log)
    assert shell_words(log, "c.mcap") == f"'{log}' c.mcap"
