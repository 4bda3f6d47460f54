"""Stateless functions on arrays: lens distortion, markers, poses, trilateration."""
