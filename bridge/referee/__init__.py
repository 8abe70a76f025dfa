"""A passive listener that compares the frames on the buses with the plan."""
