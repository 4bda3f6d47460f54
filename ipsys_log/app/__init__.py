"""The program: commands, web pages, the first day of a lab, reports. They parse, call and draw.

Entry: :data:`~ipsys_log.app.cli.app.app`, the command ``ipsys``. Read first: ``cli/app.py``,
``cli/stages.py``, ``report/html.py``.
"""
