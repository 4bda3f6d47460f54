"""Indoor positioning with cheap cameras: everything is a channel in a log.

The command is ``ipsys``; the pipeline is in :mod:`ipsys_log.pipeline`.
"""

__version__: str


def __getattr__(name: str) -> str:
    # The command notes signals as early as it can: the import below takes longer than all before it.
    if name == "__version__":
        from importlib.metadata import version

        return version("ipsys_log")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
