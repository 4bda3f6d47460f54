"""Calibration points: entry and checks of tape measurements, in finished logs and with live cameras."""
