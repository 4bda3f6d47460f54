"""Messages of the pipeline: frozen payloads; each mirrors one schema of the log.

A field has the same name as the field of the schema; :mod:`ipsys_log.log.codec` converts between them by
these names and types. Lengths are in metres, angles in radians, times in nanoseconds since 1970 (UTC). A
missing value is ``None`` or empty, never 0 and never NaN.
"""

from ipsys_log.messages.channels import (
    COMMANDS_TOPIC,
    EVENTS_TOPIC,
    LATENCY_TOPIC,
    MEASUREMENTS_TOPIC,
    PATHS_TOPIC,
    RIG_TOPIC,
    TRUTH_TOPIC,
    calibration_topic,
    clock_topic,
    image_topic,
)
from ipsys_log.messages.events import (
    ASSUMED_MODEL,
    CAMERA_MOVED,
    FRAME_SKIPPED,
    IMPORTED,
    STAMP_UNRELIABLE,
    ChannelCut,
    ChannelRead,
    ChannelWritten,
    ClockEstimate,
    Cut,
    Event,
    Latency,
    Lens,
    Merge,
    MergedLog,
    Run,
)
from ipsys_log.messages.images import (
    CameraPoint,
    CameraPoints,
    Color,
    CompressedImage,
    CompressedVideo,
    ImageAnnotations,
    Marker,
    MarkerPose,
    Markers,
    Point2,
    PointsAnnotation,
    RawImage,
    SkippedVideo,
    TextAnnotation,
)
from ipsys_log.messages.message import Array, Encoded, Grey, Indices, Mask, Message, Times, kind_of
from ipsys_log.messages.models import (
    CameraEvaluation,
    CameraModel,
    CameraPose,
    CameraPoses,
    Distance,
    ErrorStatistics,
    Evaluation,
    Interval,
    LearningPoint,
    Measurement,
    Model,
    Noise,
    Pair,
    Parameter,
    Residual,
    Suspect,
    WorldPoint,
)
from ipsys_log.messages.rig import (
    CameraCalibration,
    Floor,
    ReferenceMarker,
    ReferencePoint,
    Rig,
    RigBody,
    RigCamera,
    RigMarker,
    RigNodes,
    RigStream,
)
from ipsys_log.messages.tracks import (
    DRIVING,
    FINISHED,
    HOLDING,
    STOPPED,
    FrameTransform,
    FrameTransforms,
    Position,
    Positions,
    Quaternion,
    RobotPath,
    Track,
    Tracks,
    Vector3,
    Waypoint,
    WheelCommand,
)
