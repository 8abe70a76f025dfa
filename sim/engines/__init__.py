"""All roles of a run in one process."""
