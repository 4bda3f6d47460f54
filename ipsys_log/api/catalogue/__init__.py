"""The catalogue of a folder: a table with a row for each log, for questions over many logs."""
