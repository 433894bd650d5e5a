"""`podwatch doctor`: what this machine lacks to fly, to simulate or to look at a fleet, and what mends it."""
