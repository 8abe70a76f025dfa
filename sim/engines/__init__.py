"""The engine that runs all roles in one process."""
