"""Data of others, in and out: what they wrote, as messages."""
