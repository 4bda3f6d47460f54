"""``python -m ipsys_log`` is ``ipsys``."""

from ipsys_log.app.cli import main

main()
