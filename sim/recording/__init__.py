"""A run as an MCAP file: written, read back, mended.  Where mcap is imported."""
