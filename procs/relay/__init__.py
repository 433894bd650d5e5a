"""The relay: the only process whose socket leaves the drone (docs/relay.md)."""
