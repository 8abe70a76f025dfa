"""Parts of a run that others wrote: found, tried, kept."""
