"""The formation: tree nodes, centroid-based transformation, control laws, trajectories, collision avoidance, stability."""
