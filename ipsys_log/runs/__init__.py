"""Runs of stages on logs: their plan, provenance, state, execution and verification."""
