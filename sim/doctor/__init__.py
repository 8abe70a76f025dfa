"""Checks of this machine, and of whether a scenario fits it."""
