"""Recordings and live display in Rerun."""
