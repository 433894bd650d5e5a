"""`podwatch fleet`: the fleet file, its key, what a drone still lacks, and its systemd units."""

from tools.fleet.commands import app

__all__ = ["app"]
