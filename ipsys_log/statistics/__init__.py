"""Statistics of measurements, runs and cameras: functions from arrays and messages to results.

Entry: :func:`~ipsys_log.statistics.calibration_points.build_pairs` and the errors of ``accuracy.py``.
Read first: ``calibration_points.py``, ``tape.py``, ``cross_validation.py``.
"""
