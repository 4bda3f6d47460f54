"""Stages of the pipeline: each stage reads and writes channels. A stage uses no files and no clocks."""
