"""Sinks: consumers of messages."""
