"""Tracks of robots over time, from positions with the errors of their calibration; arrays in, arrays out."""
