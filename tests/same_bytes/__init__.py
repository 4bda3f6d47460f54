"""Compare what two commits compute, byte for byte: ``scripts/same-bytes OLD NEW``."""
