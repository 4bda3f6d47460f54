"""Tracks of robots over time, with the errors of the calibration: arrays in, arrays out."""
