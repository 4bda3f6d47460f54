"""The dashboard: a page that shows a running recording, for any number of browsers."""
