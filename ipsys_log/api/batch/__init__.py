"""Work on many logs by many processes, with Dask: a task for each log, and for each piece of a long log."""
