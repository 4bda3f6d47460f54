"""Models: scikit-learn estimators from camera points to world points, and the joint model; in
``tracking``, tracks of robots from the positions of all cameras.

Entry: ``MODELS`` in ``table.py``. Read first: ``table.py``, ``rays.py``, ``tracking/filter.py``.
"""
