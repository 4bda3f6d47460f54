"""What places are measured on: a finished log, with a sheet of its own, or what the cameras see now."""
