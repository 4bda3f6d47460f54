"""The Python API of ``import ipsys_log as ipsys``; the work on many logs, and their catalogue.

Entry: :mod:`~ipsys_log.api.python_api` has every public function. Read first: ``python_api.py``,
``opened_log.py``, ``batch/tasks.py``.
"""
