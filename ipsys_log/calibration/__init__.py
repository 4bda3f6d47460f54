"""Calibration: camera intrinsics from boards; in ``joint``, all cameras of a lab, its floor and its tape.

Entry: :func:`~ipsys_log.calibration.calibrate.calibrate` and
:func:`~ipsys_log.calibration.joint.fit.fit_jointly`. Read first: ``solve.py``, ``joint/problem.py``,
``joint/fit.py``.
"""
