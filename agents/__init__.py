"""The robot: its plants, its torque loop, its role."""
