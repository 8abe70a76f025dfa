"""The tree node: centroid-based transformation, control laws, trajectories, collision avoidance."""
