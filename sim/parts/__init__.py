"""Users' own parts of a run: loading, trying, and limiting their time."""
