"""Analysis of measurements, runs and cameras: functions from arrays and messages to results."""
