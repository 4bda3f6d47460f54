"""Tracks of robots over time: a filter of positions with the errors of the calibration; arrays in, arrays out."""
