"""What a run was: its trace, what is measured of it, and the summary."""
