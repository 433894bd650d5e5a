"""What the report's tests share: a fleet that says its map, hostile words, and a page taken apart."""

import re
from html.parser import HTMLParser
from pathlib import Path

from lcmtypes import make, podwatch
from tests.unit.fake_run import FakeRun

VOID = {"meta", "img", "path", "br", "link", "rect", "input"}
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>'\"&amp;{{ 7 * 7 }}<!--"


class Outline(HTMLParser):
    """Checks that every element is closed, collects what a browser would fetch and run, and the words."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.fetched: list[str] = []
        self.scripts: list[str] = []
        self.handlers: list[str] = []
        self.words = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.fetched += [value or "" for name, value in attrs if name in ("src", "srcset", "data")]
        self.fetched += [value or "" for name, value in attrs if name == "href" and tag != "a"]
        self.handlers += [name for name, _ in attrs if name.startswith("on")]
        if tag == "script":
            self.scripts.append(dict(attrs).get("type") or "")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open, f"</{tag}> closes nothing"
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"script", "style"} & set(self.open):
            self.words += data


class MappedRun(FakeRun):
    """A fleet whose drones say the map too, as real ones do, and their links."""

    def _identities(self, drone: int, t_s: float) -> podwatch.identities_t:
        named = super()._identities(drone, t_s)
        if t_s >= self.monitor_s[0] - 0.5:
            named.map = [
                make(
                    podwatch.map_animal_t,
                    id=self.name(drone, animal, t_s),
                    n_m=self.animal(animal, t_s)[0],
                    e_m=self.animal(animal, t_s)[1],
                    size_m=10.0,
                    mine=animal == drone,
                    residual_m=0.3,
                )
                for animal in self.animal_ids
            ]
            named.n_map = len(named.map)
        return named

    def _vehicle_state(self, drone: int, t_s: float) -> podwatch.vehicle_state_t:
        state = super()._vehicle_state(drone, t_s)
        state.position_ok = True
        return state

    def _link_state(self, drone: int, t_s: float) -> podwatch.link_state_t:
        state = super()._link_state(drone, t_s)
        for link in state.links:
            link.offset_us = self.utime(link.peer_id, t_s) - self.utime(drone, t_s)
        return state


def words_of(page: str) -> str:
    return re.sub(r"\s+", " ", Outline(page).words)


def logs_only(folder: Path, run: FakeRun) -> Path:
    run.write(folder)
    for name in ("truth.json", "truth.mcap", "mission.json"):
        (folder / name).unlink()
    return folder
