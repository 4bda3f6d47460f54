"""The page of ``ipsys setup``: it serves the steps of the first day."""
