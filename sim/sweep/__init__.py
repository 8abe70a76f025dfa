"""Sweeps: many runs of a scenario with values that vary (docs/sweep.md)."""
