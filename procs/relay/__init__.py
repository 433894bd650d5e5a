"""The relay: the only process whose socket leaves the drone (DESIGN section 4, docs/relay.md)."""
