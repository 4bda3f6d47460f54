"""Files of other programs: calibration files, bags, images, tables, trajectories; in both directions.

Entry: one module for each format. Read first: ``calibration_formats.py``, ``ros_bags.py``, ``export.py``.
"""
