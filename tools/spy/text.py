"""What `podwatch spy --text` prints: columns that a script can split at blanks, the newest message last."""

from tools.spy.listener import Listener
from tools.spy.pages import ring_page
from tools.spy.ring import Ring
from tools.spy.values import brief, member_lines

__all__ = ["channel_text", "ring_text"]

WIDE = 1000  # no line is cut
HEADINGS = ("channel", "hz", "nominal_hz", "jitter_ms", "bytes_s", "gaps", "age_s", "newest")
WIDTHS = (20, 8, 10, 10, 11, 6, 8)


def channel_text(listener: Listener, now_us: int, *, is_detailed: bool) -> list[str]:
    """A line a channel, "-" where there is no figure; `is_detailed`: below it a line a member."""
    since_us = listener.statistics.since_us
    lines = [_columns(HEADINGS)]
    for channel in listener.statistics.in_order():
        newest = listener.newest(channel.name)
        jitter_ms = channel.jitter_ms(now_us)
        cells = (
            channel.name,
            f"{channel.rate_hz(now_us, since_us):.2f}",
            f"{channel.nominal_hz:g}" if channel.nominal_hz else "-",
            "-" if jitter_ms is None else f"{jitter_ms:.3f}",
            f"{channel.bytes_s(now_us, since_us):.0f}",
            str(channel.n_lost) if channel.kind else "-",
            f"{(now_us - channel.last_us) / 1e6:.3f}",
            brief(newest),
        )
        lines.append(_columns(cells))
        if is_detailed:
            lines += [f"  {name} = {value}" for name, value, _ in member_lines(newest)]
    if listener.n_dropped:
        lines.append(f"# {listener.n_dropped} messages were missed here: this machine is too busy")
    return lines


def ring_text(ring: Ring, now_us: int) -> list[str]:
    """The ring's page without colour."""
    return [line.plain.rstrip() for line in ring_page(ring, now_us, WIDE)]


def _columns(cells: tuple[str, ...]) -> str:
    first, *others = zip(cells, WIDTHS, strict=False)
    return (
        f"{first[0]:<{first[1]}}" + "".join(f" {cell:>{width}}" for cell, width in others) + f"  {cells[-1]}"
    )
