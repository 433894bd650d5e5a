"""Simulated runs: the world, its two ways to fly a fleet, and what is left behind."""
