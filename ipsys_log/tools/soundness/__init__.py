"""Soundness of logs: the file, its channels, their references, and the provenance of runs."""
