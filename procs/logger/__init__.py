"""The logger: the whole bus of one drone, kept in an MCAP file."""
