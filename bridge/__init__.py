"""The CAN side: buses, drive protocols, the bridge that puts wheel torques on a bus, and the referee."""
