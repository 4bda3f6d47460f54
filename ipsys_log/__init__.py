"""Indoor positioning with cheap cameras: everything is a channel in a log.

The command is ``ipsys``; the pipeline is in :mod:`ipsys_log.pipeline`.
"""

from importlib.metadata import version

__version__ = version("ipsys_log")
