"""Units of texts and reports. All other values are in metres, radians and nanoseconds."""

from datetime import UTC, datetime

CM_PER_M = 100.0
MM_PER_M = 1000.0
NS_PER_S = 1_000_000_000


def format_time(time_ns: int) -> str:
    """Return a time since 1970 as UTC to the millisecond.

    Examples
    --------
    >>> format_time(1_500_000_000_123_000_000)
    '2017-07-14 02:40:00.123'
    """
    seconds, rest_ns = divmod(time_ns, NS_PER_S)
    moment = datetime.fromtimestamp(seconds, tz=UTC)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{rest_ns // 1_000_000:03d}"


def format_bytes(count: int) -> str:
    """Return a size in powers of ten.

    Examples
    --------
    >>> format_bytes(1_234_567)
    '1.2 MB'
    """
    size = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} TB"


def format_duration(seconds: float) -> str:
    """Return a duration in the unit with the fewest digits.

    Examples
    --------
    >>> format_duration(42.4), format_duration(60), format_duration(1800), format_duration(9000)
    ('42 s', '1 minute', '30 minutes', '2.5 hours')
    >>> format_duration(500_000)
    '6 days'
    """
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 120:
        return f"{minutes} minute{'' if minutes == 1 else 's'}"
    hours = seconds / 3600
    return f"{hours:.1f} hours" if hours < 48 else f"{hours / 24:.0f} days"
