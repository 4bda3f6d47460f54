"""The sizes of the channels of a log as a table and as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from ipsys_log.log.channel_sizes import ChannelSize
from ipsys_log.plain_text import plain_text
from ipsys_log.units import format_bytes

_NUMBERS = ("messages", "payload", "in the file", "share")


def sizes_json(path: str, file_bytes: int, sizes: Sequence[ChannelSize]) -> dict[str, Any]:
    """Return the sizes of a log as plain data, in bytes; ``share`` is of the file."""
    stored_bytes = sum(size.stored_bytes for size in sizes)
    return {
        "path": path,
        "bytes": file_bytes,
        "channels": [
            {
                "topic": size.topic,
                "messages": size.messages,
                "payload_bytes": size.payload_bytes,
                "stored_bytes": size.stored_bytes,
                "share": size.stored_bytes / file_bytes,
            }
            for size in sizes
        ],
        "other_bytes": file_bytes - stored_bytes,
    }


def sizes_table(sizes: dict[str, Any]) -> Table:
    """Return the sizes of :func:`sizes_json` as a table, in 80 columns if the topics are short enough."""
    title = f"{plain_text(sizes['path'])}, {format_bytes(sizes['bytes'])}"
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    table.add_column("topic", overflow="fold")
    for name in _NUMBERS:
        table.add_column(name, justify="right", no_wrap=True)
    for row in sizes["channels"]:
        table.add_row(
            Text(plain_text(row["topic"])), str(row["messages"]), format_bytes(row["payload_bytes"]),
            format_bytes(row["stored_bytes"]), _percent(row["share"]),
        )  # fmt: skip
    share = sizes["other_bytes"] / sizes["bytes"]
    table.add_row("(definitions, indexes)", "", "", format_bytes(sizes["other_bytes"]), _percent(share))
    return table


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
