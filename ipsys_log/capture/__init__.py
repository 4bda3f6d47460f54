"""Cameras and recordings: one thread for each camera, one source of messages, one recorder; nodes of other
hosts; in ``simulation``, the rendered lab, whose cameras are opened like real ones.

Entry: :func:`~ipsys_log.capture.recorder.write_each`. Read first: ``frames.py``, ``multiplexer.py``,
``recorder.py``.
"""
