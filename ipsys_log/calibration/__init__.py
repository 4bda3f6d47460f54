"""Before there are positions: what a lens does, and how a camera hangs."""
