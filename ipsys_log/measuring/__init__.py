"""Entering tape measurements: what is typed, what the cameras see, whether both can be right.

No files, sockets, clocks or screens: the page, the terminal and the sheet ask the same questions here.
"""
