"""The robot: its plant and its torque loop."""
