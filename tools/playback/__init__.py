"""Recorded logs on real buses again: `podwatch play`."""
