"""Trajectories in bags of ROS 1 and ROS 2: odometry, poses and transforms by frame names."""

from array import array
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.typesys import Stores

from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.ros_bags import BagReader, faults, message_types, open_bag, raw_messages, ros1_types
from ipsys_log.exchange.trajectory_tables import Reading, make_trajectory
from ipsys_log.plain_text import join_names
from ipsys_log.statistics.trajectories import Trajectory
from ipsys_log.units import NS_PER_S

_STEP = "bag"
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_TF = "/tf:"
# The pose of a message, by its type.
_POSES: dict[str, Callable[[Any], Any]] = {
    "nav_msgs/msg/Odometry": lambda message: message.pose.pose,
    "geometry_msgs/msg/PoseStamped": lambda message: message.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: message.pose.pose,
    "geometry_msgs/msg/TransformStamped": lambda message: message.transform,
}
_WITH_COVARIANCE = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped")


@dataclass(slots=True)
class _PoseRows:
    """The poses of a topic or of a pair of frames while they are read."""

    is_static: bool = False
    times_ns: "array[int]" = field(default_factory=lambda: array("q"))
    values: "array[float]" = field(default_factory=lambda: array("d"))
    covariances: "array[float]" = field(default_factory=lambda: array("d"))
    without_stamp: int = 0

    def add(self, time_ns: int, header: Any, pose: Any, covariance: Any = None) -> None:
        stamp_ns = int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec)
        self.without_stamp += stamp_ns == 0
        self.times_ns.append(stamp_ns or time_ns)
        place = pose.position if hasattr(pose, "position") else pose.translation
        turn = pose.orientation if hasattr(pose, "orientation") else pose.rotation
        self.values.extend((place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))
        if covariance is not None:
            self.covariances.extend(np.asarray(covariance, dtype=np.float64).tolist())

    def trajectory(self, where: str, name: str) -> Trajectory:
        """Return the poses in the order of their times."""
        values = np.array(self.values).reshape(-1, 7)
        covariances = np.array(self.covariances).reshape(-1, 6, 6)
        # Without a covariance, nodes write zeros, or -1 as the first element.
        is_known = len(covariances) and np.any(covariances) and covariances[0, 0, 0] >= 0
        times_ns = np.array(self.times_ns, dtype=np.int64)
        return make_trajectory(
            where, name, times_ns, values[:, :3], values[:, 3:], covariances if is_known else None
        )


def read_bag_trajectories(path: Path, bodies: Sequence[str], progress: Progress) -> Reading:
    """Read the poses of topics of a bag, or of frames in its transforms.

    Parameters
    ----------
    bodies : topics, or frames such as ``/tf:map.base_link``; empty: the only topic of poses.

    Raises
    ------
    IpsysError
        The bag is damaged, a topic does not exist or has no poses, or it is not clear which topic is wanted.
    """
    with open_bag(path) as reader:
        poses = [one for one in reader.connections if one.msgtype in _POSES]
        transforms = [one for one in reader.connections if one.msgtype in _TRANSFORMS]
        topics = list(dict.fromkeys(one.topic for one in poses))
        wanted = [name for name in bodies if name in topics] or topics[: not bodies and len(topics) == 1]
        frames = [name for name in bodies if name.startswith(_TF) and transforms]
        if not wanted and not frames and (bodies or topics or not transforms):
            known = [f"{one.topic} ({one.msgtype.split('/')[-1]}, {one.msgcount})" for one in poses]
            known += [f"{_TF}PARENT.CHILD"] * bool(transforms)
            fault = (
                f"has no topic {' or '.join(bodies)} with poses"
                if bodies
                else "has several topics with poses"
            )
            advice = "select one: --robot NAME=TOPIC" if known else "its topics have other types"
            raise IpsysError(f"{path}: {fault}; {advice}. Topics: {join_names(known, 12) or 'none'}")
        by_topic = {topic: _PoseRows() for topic in wanted}
        edges: dict[tuple[str, str], _PoseRows] = {}
        connections = [one for one in poses if one.topic in wanted]
        connections += transforms if frames or not wanted else []
        total = sum(one.msgcount for one in connections)
        decode = {one.id: _decoder(path, reader, one) for one in connections}
        for done, (connection, time_ns, data) in enumerate(raw_messages(path, reader, connections)):
            progress(_STEP, done, total)
            with faults(path):
                message = decode[connection.id](data)
            if connection.msgtype in _POSES:
                covariance = message.pose.covariance if connection.msgtype in _WITH_COVARIANCE else None
                pose = _POSES[connection.msgtype](message)
                by_topic[connection.topic].add(time_ns, message.header, pose, covariance)
                continue
            for one in message.transforms:
                names = one.header.frame_id.strip("/"), one.child_frame_id.strip("/")
                edge = edges.setdefault(names, _PoseRows(connection.topic.endswith("static")))
                edge.add(time_ns, one.header, one.transform)
        progress(_STEP, total, total)
    found = [rows.trajectory(f"{path}: {topic}", topic) for topic, rows in by_topic.items()]
    found += _frame_trajectories(path, frames, edges) if frames or not wanted else []
    without = sum(rows.without_stamp for rows in (*by_topic.values(), *edges.values()) if not rows.is_static)
    remarks = [f"{path.name}: {without} messages have no stamp; the times of the bag are used"] * bool(
        without
    )
    said = [f"{topic}: {next(one.msgtype for one in poses if one.topic == topic)}" for topic in wanted]
    kind = f"bag of ROS {1 if path.suffix == '.bag' else 2}"
    return Reading(found, kind, [*said, *["transforms"] * bool(edges), "SI units"], tuple(remarks))


def _decoder(path: Path, reader: BagReader, connection: Connection) -> Callable[[bytes], Any]:
    name = connection.msgtype
    if isinstance(reader, Reader1):
        store = ros1_types(path, connection)
        return lambda data: store.deserialize_ros1(data, name)
    types = message_types(Stores.ROS2_JAZZY)
    return lambda data: types.deserialize_cdr(data, name)


def _frame_trajectories(
    path: Path, frames: Sequence[str], edges: dict[tuple[str, str], _PoseRows]
) -> list[Trajectory]:
    """Return the poses of frames; without a selection, those of the only pair of frames that moves."""
    moving = [f"{_TF}{parent}.{child}" for (parent, child), rows in edges.items() if not rows.is_static]
    if not frames and len(moving) != 1:
        raise IpsysError(
            f"{path}: has several pairs of frames; select one: --robot NAME={_TF}PARENT.CHILD. Pairs: "
            f"{join_names(moving, 12) or 'none that moves'}"
        )
    return [_compose(f"{path}: {name}", name, edges, moving) for name in frames or moving]


def _compose(
    where: str, name: str, edges: dict[tuple[str, str], _PoseRows], moving: Sequence[str]
) -> Trajectory:
    """Return the poses of a child frame in a parent frame, by the chain of transforms between them."""
    from scipy.spatial.transform import Rotation, Slerp

    parts = []
    for edge in _find_chain(name.removeprefix(_TF), edges):  # from the child up
        path = edges[edge].trajectory(where, "")
        # Transforms of /tf_static hold at all times.
        rows = np.flatnonzero(np.isfinite(path.quaternions[:, 0]))[: 1 if edges[edge].is_static else None]
        parts.append((path.times_ns[rows], path.points_m[rows], path.quaternions[rows]))
    dynamic = [part[0] for part in parts if len(part[0]) > 1]
    if not dynamic or not all(len(part[0]) for part in parts):
        raise IpsysError(f"{where}: has no moving transforms (PARENT.CHILD). Pairs: {join_names(moving, 12)}")
    times_ns = max(dynamic, key=len)
    first_ns, last_ns = max(times[0] for times in dynamic), min(times[-1] for times in dynamic)
    times_ns = times_ns[(times_ns >= first_ns) & (times_ns <= last_ns)]
    points, turns = np.zeros((len(times_ns), 3)), Rotation.identity(len(times_ns))
    for own_ns, shifts, quaternions in parts:
        turn = Rotation.from_quat(quaternions)
        own_s, at_s = (own_ns - first_ns) / NS_PER_S, (times_ns - first_ns) / NS_PER_S
        shift = np.column_stack([np.interp(at_s, own_s, axis) for axis in shifts.T])
        turn = Slerp(own_s, turn)(at_s) if len(own_s) > 1 else turn
        points, turns = turn.apply(points) + shift, turn * turns
    return make_trajectory(where, name, times_ns, points, turns.as_quat())


def _find_chain(name: str, edges: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the pairs of frames from the child up to the parent of ``parent.child``; empty if none fit.

    The names of frames may have points, too.
    """
    parents = {child: parent for parent, child in edges}
    for at in (at for at, mark in enumerate(name) if mark == "."):
        chain: list[tuple[str, str]] = []
        frame = name[at + 1 :]
        while frame != name[:at] and frame in parents and len(chain) < len(parents):
            chain.append((parents[frame], frame))
            frame = parents[frame]
        if frame == name[:at]:
            return chain
    return []
