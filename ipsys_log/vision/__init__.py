"""Images, markers and lenses: functions on arrays, without files and without logs.

Entry: :func:`~ipsys_log.vision.markers.camera_point`, from the corners of a marker to its point in camera
coordinates. Read first: ``markers.py``, ``lenses.py``, ``square_pose.py``.
"""
