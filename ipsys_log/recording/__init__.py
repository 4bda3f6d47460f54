"""Recording: what cameras send now, into a log; and how much of it the stages see, and when.

``recorder`` writes and hands on, ``waiting`` says what is skipped under load, ``recent`` keeps only what is
measured, ``full_disk`` sets space aside for the end, ``plan`` is that of a live run, ``latency`` its times,
``monitor`` looks at the pictures meanwhile.
"""
