"""Analysis of measurements, runs and cameras: arrays and messages in, results out."""
