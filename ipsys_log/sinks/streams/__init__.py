"""Streams: sinks that send poses of robots to other programs."""
