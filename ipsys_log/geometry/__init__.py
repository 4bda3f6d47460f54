"""Arrays in, arrays out, no state: lenses, markers, trilateration."""
