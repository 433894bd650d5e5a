"""`podwatch spy`: what is said on a drone's bus, how often and how evenly, and how the ring fares."""
