"""Capture: cameras, their threads, and the recorder."""
