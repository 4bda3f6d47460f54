"""Messages: a payload on a topic; the types of the fields of payloads, and of other arrays."""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

# Types of arrays; docstrings give the shapes.
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
Times = NDArray[np.int64]
Grey = NDArray[np.uint8]

# Types of the fields of payloads.
TimeNs = Annotated[int, "google.protobuf.Timestamp"]
Floats = Annotated[NDArray[np.float64], (-1,)]
Vec3 = Annotated[NDArray[np.float64], (3,)]
Vec6 = Annotated[NDArray[np.float64], (6,)]
Mat33 = Annotated[NDArray[np.float64], (3, 3)]
Mat34 = Annotated[NDArray[np.float64], (3, 4)]
Corners = Annotated[NDArray[np.float64], (4, 2)]
Mat66 = Annotated[NDArray[np.float64], (6, 6)]
Mat88 = Annotated[NDArray[np.float64], (8, 8)]


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """A payload on a topic, with the two times of the log.

    ``camera`` is the camera of the message; None for a rig, a measurement or a track.
    """

    topic: str
    log_time_ns: int
    publish_time_ns: int
    payload: Any
    camera: str | None = None

    def __repr__(self) -> str:
        return f"<Message {self.topic} at {self.log_time_ns} ns: {type(self.payload).__name__}>"


@dataclass(frozen=True, slots=True, eq=False)
class Encoded:
    """A payload as the bytes of the log, on its way into the log, and its type."""

    kind: type
    data: bytes


def kind_of(payload: Any) -> type:
    """Return the type of a payload, encoded or not."""
    return payload.kind if isinstance(payload, Encoded) else type(payload)
