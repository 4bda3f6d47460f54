"""Statistics of measurements, runs and cameras: functions from arrays and messages to results.

Entry: :func:`~ipsys_log.statistics.pairs.build_pairs` and the errors of ``accuracy.py``. Read first:
``pairs.py``, ``tape.py``, ``cross_validation.py``.
"""
