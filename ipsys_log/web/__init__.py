"""The measuring page: a small web server for the phone of the person who measures."""
