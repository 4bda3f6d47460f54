"""The measuring page: a small web server for a phone beside the tape."""
