"""Live displays in a terminal."""
