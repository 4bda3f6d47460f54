"""The pages: a small web server for the measuring page and for the dashboard."""
