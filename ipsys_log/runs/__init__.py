"""Runs: what is asked for, what each stage reads for it, how a run is found, made, completed and signed.

``request`` is what the user asks for, ``tasks`` the plan of each stage, ``lookup`` what is asked of a log,
``records`` what a run says of itself, ``preflight`` refuses what cannot work, ``perform`` does one stage,
``resume`` continues a run that was cut short, ``remarks`` are for the user, ``output`` writes.
"""
