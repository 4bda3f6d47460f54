"""A lens from pictures of a board: found, chosen, fitted, with what is known of its errors."""
