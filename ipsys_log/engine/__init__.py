"""Runs of stages on logs: their plan, provenance, state, execution and verification.

Entry: :func:`~ipsys_log.engine.execute.run_stage` runs one stage on a log. Read first: ``stream.py``,
``graph.py``, ``execute.py``.
"""
