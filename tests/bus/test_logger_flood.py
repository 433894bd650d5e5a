"""A flood on a real bus, small enough for any machine: our logger and lcm-logger keep all of it.

`podwatch bench logs` measures the same at 20,000 messages a second.
"""

from lcmtypes import channels
from tools.bench import logs as bench


def test_both_loggers_keep_a_small_flood_with_images(tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "FLOOD_HZ", 1000)
    said, ours, theirs, _ = bench.flood(tmp_path, 0.3, with_images=True)
    assert said[channels.TRACK] == 300
    assert said[channels.IMAGE] >= 1
    assert ours == theirs == said


def test_playing_says_every_message_and_how_late():
    [row] = bench.playing_rows(0.2)
    assert row.n == bench.PLAYED_DRONES * (60 + 1)
    assert "p99" in row.figure
