"""Sinks: consumers of messages, live or from a log: streams to robots, viewers, videos, ROS 2 bags.

Entry: the protocol :class:`~ipsys_log.sinks.sink.Sink`. Read first: ``sink.py``, ``streams/udp.py``,
``playback.py``.
"""
