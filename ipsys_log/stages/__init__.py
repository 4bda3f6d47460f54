"""Stages of the pipeline: each reads channels and writes channels. They know no files and no clocks."""
