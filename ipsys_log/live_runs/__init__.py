"""Live runs, and what is built on them: the whole pipeline, calibration points by hand, robot runs.

Entry: :func:`~ipsys_log.live_runs.pipeline.live` and its neighbours. Read first: ``pipeline.py``,
``survey/live.py``, ``robot_runs/run.py``.
"""
