"""Logs: read, write, append and repair MCAP files."""
