"""A run as processes: the supervisor, which starts, watches and ends them, and the processes themselves."""
