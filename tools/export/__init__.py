"""Recorded logs in the formats of other programs: maps, tables, Foxglove, Rerun."""
