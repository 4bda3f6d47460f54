"""Calibration points from logs and live cameras: entry, checks, and the result of a joint calibration."""
