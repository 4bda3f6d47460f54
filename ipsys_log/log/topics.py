"""What stands in a topic: a run, a camera."""

from __future__ import annotations

import re

__all__ = ["camera_of_topic", "clean_name", "foreign_camera", "run_of_topic"]

_OWN = re.compile(r"(?:/runs/(?P<run>[a-z][a-z0-9_]*))?/cameras/(?P<camera>[a-z][a-z0-9_]*)/[a-z_]+")
_RUN = re.compile(r"/runs/(?P<run>[a-z][a-z0-9_]*)/")
# What a topic's last parts say of an image, and not of which camera took it.
_GENERIC = re.compile(
    r"(image|images|raw|rect|color|colour|mono|compressed|calibration|camera_info|info|jpeg)"
    r"(_(raw|rect|color|colour|mono|compressed))*"
)


def camera_of_topic(topic: str) -> str | None:
    """The camera in a topic of our own, such as ``/runs/stock/cameras/red/markers``."""
    match = _OWN.fullmatch(topic)
    return match["camera"] if match else None


def run_of_topic(topic: str) -> str | None:
    """The run in a topic, or None for what was recorded."""
    match = _RUN.match(topic)
    return match["run"] if match else None


def foreign_camera(topic: str) -> str:
    """The camera in a topic of somebody else's, such as ``/robot/front/image_raw/compressed``."""
    parts = topic.strip("/").split("/")
    while len(parts) > 1 and _GENERIC.fullmatch(clean_name(parts[-1])):
        parts.pop()
    return clean_name("/".join(parts))


def clean_name(text: str) -> str:
    """A name as cameras have them, out of any text."""
    name = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    return name if name[:1].isalpha() else f"camera_{name}".rstrip("_")
