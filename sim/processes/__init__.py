"""A run as processes: brought up, watched over, taken down."""
