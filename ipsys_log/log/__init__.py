"""Logs: read, write, append, repair. Topics, schemas, bytes and times; payloads are the codec's."""

from ipsys_log.log.reader import LogReader
from ipsys_log.log.repair import RepairReport, repair
from ipsys_log.log.types import Channel, RawMessage, Schema
from ipsys_log.log.writer import LogWriter

__all__ = ["Channel", "LogReader", "LogWriter", "RawMessage", "RepairReport", "Schema", "repair"]
