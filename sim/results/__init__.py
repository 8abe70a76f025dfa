"""The results of a run: its trace, what is computed from it, the checks with the verdict, and the summary."""
