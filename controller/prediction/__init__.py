"""Predictions about a run without running it: stability, and how much delay it bears."""
