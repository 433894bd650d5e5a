"""The pages of `podwatch spy`, as lines that fit a width: channels and the newest message, and the ring."""

from rich.text import Text

from tools.spy.listener import Listener
from tools.spy.ring import NEVER_S, Belief, LinkRow, Ring
from tools.spy.statistics import BusStatistics, ChannelStatistics
from tools.spy.values import HEAD as HEAD_MEMBERS
from tools.spy.values import brief, head_line, member_lines

__all__ = ["channel_page", "ring_page"]

BAD, DOUBTFUL, GOOD, HEAD, FAINT = "bold red", "yellow", "green", "bold", "dim"
STALE_S = 2.0  # a channel with a nominal rate that is silent for longer stands out
HIGH_LOSS, HIGH_LOAD = 0.2, 0.8
WIDE = 110  # columns in which a link's bytes by kind stand beside it
HEADINGS = (
    f"{'':1}{'channel':<20}{'Hz':>7}{'of':>4}{'jitter':>8}{'bytes/s':>9}{'gaps':>6}{'age s':>7}  newest"
)


def channel_page(listener: Listener, selected: str, now_us: int, width: int, height: int) -> list[Text]:
    """Every channel, and below the newest message of the selected one as far as there is room."""
    statistics = listener.statistics
    shown = statistics.in_order()
    lines = [_bus_line(listener, now_us), Text(HEADINGS, style=FAINT)]
    names = [channel.name for channel in shown]
    n_rows = height - 3
    if selected in names:  # where not all fit, a chosen message gets half of the screen
        n_rows = max(height // 2 - 3, height - 5 - len(member_lines(listener.newest(selected))), 4)
    place = names.index(selected) if selected in names else 0
    first = min(max(0, place - n_rows + 1), max(len(shown) - n_rows, 0))
    for channel in shown[first : first + n_rows]:
        newest = brief(listener.newest(channel.name))
        line = _channel_line(statistics, channel, now_us, is_selected=channel.name == selected)
        lines.append(line.append(f"  {newest}"))
    if not shown:
        waited_s = (now_us - statistics.since_us) / 1e6
        lines.append(Text(f" nothing heard in {waited_s:.0f} s", style=DOUBTFUL))
    if len(shown) > n_rows:
        lines.append(Text(f" {len(shown) - n_rows} more channels", style=FAINT))
    if selected in names:
        lines += [Text(""), *_message_lines(listener, statistics.channels[selected], height - len(lines) - 1)]
    return [_cut(line, width) for line in lines]


def ring_page(ring: Ring, now_us: int, width: int) -> list[Text]:
    """Who lives by each drone's word, then each link with its bytes by kind."""
    beliefs, links = ring.beliefs(now_us), ring.links(now_us)
    ids = ring.known_ids()
    lines = [Text("members as each drone believes them: seconds since it had word of them", style=HEAD)]
    lines.append(Text(f" {'drone':<7}{''.join(f'{member:>6}' for member in ids)}  ring", style=FAINT))
    lines += [_belief_line(belief, ids) for belief in beliefs]
    for drone_id, silent_s in ring.silent(now_us).items():
        lines.append(Text(f" {drone_id:<7}silent for {silent_s:.0f} s", style=BAD))
    if not beliefs:
        lines.append(Text(" no FLEET_STATE heard", style=DOUBTFUL))
    lines.append(Text(""))
    lines.append(Text("links: what each end says that it sends", style=HEAD))
    columns = f"{'age s':>7}{'loss':>6}{'trip ms':>9}{'bytes/s':>8}{'cap':>7}{'of cap':>8}"
    columns += f"{'dropped':>9}{'refused':>9}"
    lines.append(Text(f" {'link':<11}{'':5}{columns}", style=FAINT))
    for link in links:
        lines += _link_lines(link, is_wide=width >= WIDE)
    if not links:
        lines.append(Text(" no LINK_STATE heard", style=DOUBTFUL))
    return [_cut(line, width) for line in lines]


def _bus_line(listener: Listener, now_us: int) -> Text:
    statistics = listener.statistics
    per_s = sum(c.rate_hz(now_us, statistics.since_us) for c in statistics.channels.values())
    bytes_s = sum(c.bytes_s(now_us, statistics.since_us) for c in statistics.channels.values())
    line = Text(f"{listener.url.partition('?')[0]}  ", style=HEAD)
    line.append(f"{per_s:.0f} messages/s, {_size(bytes_s)}B/s", style="default not bold")
    if listener.n_dropped:
        line.append(f", {listener.n_dropped} missed here (this machine is too busy)", style=BAD)
    return line


def _channel_line(
    statistics: BusStatistics, channel: ChannelStatistics, now_us: int, *, is_selected: bool
) -> Text:
    rate_hz = channel.rate_hz(now_us, statistics.since_us)
    jitter_ms, age_s = channel.jitter_ms(now_us), (now_us - channel.last_us) / 1e6
    line = Text(no_wrap=True)
    line.append(f"{'›' if is_selected else ' '}{channel.name[:19]:<20}", style=HEAD if is_selected else "")
    is_slow = channel.is_slow(now_us, statistics.since_us)
    line.append(f"{rate_hz:>7.1f}", style=DOUBTFUL if is_slow else "")
    line.append(f"{channel.nominal_hz or '':>4.3g}" if channel.nominal_hz else f"{'':4}", style=FAINT)
    line.append(f"{_jitter(jitter_ms):>8}")
    line.append(f"{_size(channel.bytes_s(now_us, statistics.since_us)):>9}")
    n_lost = channel.n_lost if channel.kind else None
    line.append(f"{'-' if n_lost is None else n_lost:>6}", style=BAD if n_lost else "")
    is_stale = channel.nominal_hz > 0 and age_s > STALE_S
    line.append(f"{age_s:>7.1f}", style=BAD if is_stale else "")
    return line


def _message_lines(listener: Listener, channel: ChannelStatistics, n_lines: int) -> list[Text]:
    """The newest message, a member a line."""
    kind = channel.kind.__name__ if channel.kind else "of no type that the channel table knows"
    message = listener.newest(channel.name)
    title = Text(f"{channel.name}  {kind}, {len(channel.data)} bytes", style=HEAD)
    lines = [title.append(f"  {head_line(message)}", style="not bold dim")]
    members = [line for line in member_lines(message) if line[0] not in HEAD_MEMBERS]
    widest = max((len(name) for name, _, _ in members), default=0)
    n_shown = n_lines - 1 if len(members) < n_lines else n_lines - 2
    for name, value, meaning in members[: max(n_shown, 0)]:
        line = Text(f" {name:<{widest}}  ", style=FAINT)
        line.append(value, style="default not dim")
        lines.append(line.append(f"  {meaning}") if meaning else line)
    if n_shown < len(members):
        lines.append(
            Text(f" {len(members) - max(n_shown, 0)} more members: --text -c shows them", style=FAINT)
        )
    return lines


def _belief_line(belief: Belief, ids: list[int]) -> Text:
    line = Text(f" {belief.drone_id:<7}")
    for member in ids:
        age_s = belief.ages_s.get(member)
        if member == belief.drone_id:
            line.append(f"{'·':>6}", style=FAINT)
        elif age_s is None:
            line.append(f"{'-':>6}", style=DOUBTFUL)
        else:
            line.append(f"{age_s:>6.1f}", style=GOOD)
    shape = "line" if belief.is_line else "ring"
    sides = f"{belief.left_id or '-'} ‹ {belief.drone_id} › {belief.right_id or '-'}"
    line.append(f"  {sides}, {shape} of {belief.n_living}", style=DOUBTFUL if belief.is_line else "")
    if belief.n_unplaced:
        line.append(f", {belief.n_unplaced} without a position", style=FAINT)
    if not belief.time_ok:
        line.append(", no fleet time", style=DOUBTFUL)
    return line


def _link_lines(link: LinkRow, *, is_wide: bool) -> list[Text]:
    ends = f"{link.drone_id} → {link.peer_id or 'boat'}"
    line = Text(f" {ends:<11}")
    line.append(f"{'up' if link.is_up else 'down':<5}", style=GOOD if link.is_up else BAD)
    line.append(f"{'never' if link.age_s >= NEVER_S else f'{link.age_s:.1f}':>7}")
    line.append(f"{link.loss:>6.0%}", style=DOUBTFUL if link.loss > HIGH_LOSS else "")
    line.append(f"{'-' if link.round_trip_ms >= NEVER_S else f'{link.round_trip_ms:.1f}':>9}")
    load = link.total_bytes_s / max(link.cap_bytes_s, 1)
    line.append(f"{link.total_bytes_s:>8}{link.cap_bytes_s:>7}")
    line.append(f"{load:>8.0%}", style=DOUBTFUL if load > HIGH_LOAD else "")
    line.append(f"{link.n_dropped:>9}{link.n_rejected:>9}")
    kinds = [f"{kind} {n_bytes}" for kind, n_bytes in sorted(link.bytes_s.items()) if n_bytes]
    if is_wide or not kinds:
        return [line.append(f"  {', '.join(kinds)}", style=FAINT)]
    return [line, Text(f"{'':17}{', '.join(kinds)}", style=FAINT)]


def _jitter(jitter_ms: float | None) -> str:
    """Always within its column: from a tenth of a second on, seconds."""
    if jitter_ms is None:
        return "-"
    return f"{jitter_ms:.1f} ms" if jitter_ms < 99.95 else f"{jitter_ms / 1000:.1f} s"


def _size(n_bytes: float) -> str:
    """1234 -> "1.2 k"."""
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if n_bytes >= size:
            return f"{n_bytes / size:.1f} {unit}"
    return f"{n_bytes:.0f} "


def _cut(line: Text, width: int) -> Text:
    line.truncate(width, overflow="ellipsis")
    line.no_wrap = True
    return line
