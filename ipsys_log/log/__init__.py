"""Logs: MCAP files, or objects in a store. Read, write, append and recover them; several logs as one
dataset.

Entry: :class:`~ipsys_log.log.dataset.Session` reads decoded messages of any logs, and
:class:`~ipsys_log.log.writer.LogWriter` writes them. Read first: ``dataset.py``, ``writer.py``,
``journal.py``.
"""
