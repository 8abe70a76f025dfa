"""What can be said of a run without running it."""
