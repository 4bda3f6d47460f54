"""``python -m ipsys_log`` is ``ipsys``."""

from ipsys_log.cli import main

main()
