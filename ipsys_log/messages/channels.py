"""Topics of the recorded channels."""

from __future__ import annotations

__all__ = [
    "EVENTS_TOPIC",
    "LATENCY_TOPIC",
    "MEASUREMENTS_TOPIC",
    "RIG_TOPIC",
    "TRUTH_TOPIC",
    "calibration_topic",
    "image_topic",
]

RIG_TOPIC = "/rig"
MEASUREMENTS_TOPIC = "/measurements"
EVENTS_TOPIC = "/events"
LATENCY_TOPIC = "/latency"
TRUTH_TOPIC = "/truth/tracks"


def image_topic(camera: str) -> str:
    return f"/cameras/{camera}/image"


def calibration_topic(camera: str) -> str:
    return f"/cameras/{camera}/calibration"
