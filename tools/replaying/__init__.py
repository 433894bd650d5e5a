"""One process over a recorded log again: `podwatch replay`."""
