"""Calibration points: entry and checks of tape measurements, in logs and while cameras send."""
