"""Work on many logs by many processes, with Dask: one task for each log."""
