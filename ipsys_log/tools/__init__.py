"""Tools on whole logs: cut, merge, verify, check, compare, publish.

Entry: one function in each file. Read first: ``verify.py``, ``cut.py``, ``merge.py``.
"""
