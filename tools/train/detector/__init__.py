"""The detector: its network, its pictures, its training, its export and its scores."""
