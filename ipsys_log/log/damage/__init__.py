"""Damaged logs: their survey, and the messages that can be saved."""
