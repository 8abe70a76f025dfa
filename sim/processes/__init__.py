"""A run as processes: starting them, watching them, ending them."""
