"""A passive listener that holds frames against the plan."""
