"""Where messages come from: files, and a simulated lab."""
