"""Causal steps of the pipeline: a message in, payloads out. They know no files and no clocks."""
