"""The detector process and its core."""
