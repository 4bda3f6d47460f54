"""The first day of a lab: its steps, read from the files of one folder, and the work of each step."""
