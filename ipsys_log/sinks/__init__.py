"""Where messages go: they are consumed here, and nothing is answered."""
