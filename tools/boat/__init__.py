"""The boat, roster member 0: sees the find, every drone and its animal, and gives orders."""
