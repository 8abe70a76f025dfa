"""What this machine can do, and whether a scenario fits it."""
