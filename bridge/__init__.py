"""CAN: frames, buses, their load, and the bridge that puts wheel torques on the bus."""
