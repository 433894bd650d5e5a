"""The assigner: which animal this drone watches, agreed round the ring, never two drones on one."""
