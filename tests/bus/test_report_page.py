"""The report in a real browser: it complains of nothing, asks for nothing, and does what people do with it.

Where this machine has Chromium, the page is opened there. Elsewhere the same page is held to what can be told
without: its script asks for no part of the page that is not there.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.bus.chromium import Page, chromium, find_chromium
from tests.unit.report_runs import HOSTILE, MappedRun, logs_only
from tools.report import make_report
from tools.report.flights import read_flight
from tools.report.page import SCRIPTS, write_report

pytestmark = pytest.mark.timeout(180)

WIDE, NARROW = 1440, 390
# Each picture of the page and of its data: [natural width, natural height, spread of its brightness].
LOOK_AT_PICTURES = """
(async () => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const sources = data.flatMap((mission) => mission.pictures.map((picture) => picture.src));
  const shown = [...document.querySelectorAll("img")].map((image) => image.src);
  const looked = [];
  for (const source of [...shown, ...sources]) {
    const image = new Image();
    image.src = source;
    try { await image.decode(); } catch { looked.push([0, 0, 0]); continue; }
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
    const brush = canvas.getContext("2d");
    brush.drawImage(image, 0, 0);
    const grey = brush.getImageData(0, 0, canvas.width, canvas.height).data.filter((value, k) => k % 4 === 1);
    looked.push([image.naturalWidth, image.naturalHeight, Math.max(...grey.slice(0, 60000)) - Math.min(...grey.slice(0, 60000))]);
  }
  return [shown.length, looked];
})()
"""  # noqa: E501
BOX = "(({{ left, top, width }}) => [left, top, width])(document.querySelector('{}').getBoundingClientRect())"
INJECTION = """
(() => {
  const script = document.createElement("script");
  script.textContent = "window.ran = 1";
  document.head.append(script);
  return window.ran;
})()
"""
PLACES = """
[...document.querySelectorAll("[data-drone]")].map((marker) => {
  const [x, y] = marker.getAttribute("transform").match(/-?[\\d.]+/g).map(Number);
  return [x, y];
})
"""
# The least contrast of any text with what lies behind it (WCAG 2), and that text.
CONTRAST = """
(() => {
  const parse = (colour) => colour.match(/[\\d.]+/g).map(Number);
  const light = (colour) => {
    const [r, g, b] = colour.map((value) => { const v = value / 255; return v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; });
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  let worst = [99, ""];
  for (const element of document.querySelectorAll("h1, h2, h3, p, li, dt, dd, td, th, button, summary, figcaption, b")) {
    if (!element.textContent.trim() || !element.getClientRects().length) continue;
    let behind = element;
    while (behind && parse(getComputedStyle(behind).backgroundColor)[3] === 0) behind = behind.parentElement;
    const [a, b] = [light(parse(getComputedStyle(element).color).slice(0, 3)), light(parse(getComputedStyle(behind || document.body).backgroundColor).slice(0, 3))];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    if (ratio < worst[0]) worst = [ratio, element.className + ": " + element.textContent.trim().slice(0, 60)];
  }
  return worst;
})()
"""  # noqa: E501


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mission of three drones, with a failure to look at."""
    run = MappedRun(aim_off_m=lambda drone, t_s: 60.0 if drone == 2 and 20 <= t_s < 26 else 0.0)
    return make_report(run.write(tmp_path_factory.mktemp("run")))


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page | None]:
    """One tab for all tests, None where this machine has no Chromium."""
    command = find_chromium()
    if command is None:
        yield None
        return
    with chromium(command, tmp_path_factory.mktemp("profile")) as page:
        yield page


def opened(browser: Page | None, report: Path, width: int = WIDE, **options: Any) -> Page | None:
    """The page in the browser; without one, its script's selectors are looked up in its text."""
    if browser is not None:
        browser.open(report, width, **options)
        assert browser.complaints == []
        return browser
    text = report.read_text(encoding="utf-8")
    page, script = text.split('<script type="application/json"')
    for name in re.findall(r'querySelector(?:All)?\("\.([a-z-]+)', script):
        assert re.search(rf'class="[^"]*\b{name}\b', page), (
            f"{SCRIPTS} want .{name}, which is not on the page"
        )
    return None


def data_of(report: Path) -> Any:
    return json.loads(re.search(r'id="data">(.*?)</script>', report.read_text(encoding="utf-8"), re.S)[1])  # type: ignore[index]


def slide_to(page: Page, t_s: float) -> None:
    page.run(
        f'(() => {{ const slider = document.querySelector(".time"); slider.value = {t_s}; '
        'slider.dispatchEvent(new Event("input")); })()'
    )


def test_it_opens_without_a_complaint_and_asks_no_network_for_anything(browser, report):
    page = opened(browser, report)
    if page is None:
        return
    assert page.requests[0] == report.resolve().as_uri()
    assert {address.split(":")[0] for address in page.requests[1:]} <= {"data"}
    assert page.run("document.querySelectorAll('.chart .curve').length") >= 8
    assert page.run("document.querySelectorAll('.mission').length") == 1


def test_the_slider_moves_every_drone_to_its_place_of_that_time(browser, report):
    page = opened(browser, report)
    if page is None:
        return
    mission = data_of(report)[0]
    slide_to(page, 5.0)
    before = np.array(page.run(PLACES))
    slide_to(page, 20.0)
    after = np.array(page.run(PLACES))
    moved = np.linalg.norm(after - before, axis=1)
    assert (moved > 20).all()
    # Pixels go with metres by one scale, north up and east right.
    east = np.array([d["e"][20] - d["e"][5] for d in mission["drones"]]) / 10
    north = np.array([d["n"][20] - d["n"][5] for d in mission["drones"]]) / 10
    scale = page.run("missions.get('m0').map.scale")
    assert after - before == pytest.approx(np.stack([east, -north], axis=1) * scale, abs=1.5)
    assert page.run("document.querySelector('.now').textContent") == "0:20"
    assert page.run("document.querySelector('.doing').textContent").startswith(
        "Drone 1 watches animal 1 · Drone 2"
    )
    assert page.complaints == []


def test_arrow_keys_on_the_slider_and_play_move_the_time(browser, report):
    page = opened(browser, report)
    if page is None:
        return
    slide_to(page, 10.0)
    page.run("document.querySelector('.time').focus()")
    for _ in range(4):
        page.key("ArrowRight")
    assert page.run("missions.get('m0').t") == pytest.approx(12.0)
    page.key("ArrowLeft")
    assert page.run("missions.get('m0').t") == pytest.approx(11.5)
    page.run("document.querySelector('.play').click()")
    page.run(
        "new Promise((done) => { const wait = () => "
        "missions.get('m0').t > 13 ? done() : setTimeout(wait, 20); wait(); })"
    )
    page.run("document.querySelector('.play').click()")
    at_s = page.run("missions.get('m0').t")
    page.settle()
    assert page.run("missions.get('m0').t") == at_s


def test_a_finding_and_a_click_on_the_time_lanes_show_their_moment(browser, report):
    page = opened(browser, report)
    if page is None:
        return
    assert "Drone 2 had lost its animal from 0:20" in page.run("document.querySelector('.wrong').textContent")
    page.run("document.querySelector('.wrong .look').click()")
    assert page.becomes("Math.abs(missions.get('m0').t - 20) < 1.5")
    page.run("new Promise(requestAnimationFrame)")
    page.run("document.querySelector('.axis').scrollIntoView({ block: 'center', behavior: 'instant' })")
    page.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    box = page.run(BOX.format(".axis"))
    for kind in ("mousePressed", "mouseReleased"):
        page.mouse(kind, box[0] + box[2] / 4, box[1] - 20, button="left", clickCount=1)
    assert page.becomes("Math.abs(missions.get('m0').t - 10) < 0.5")


def test_the_map_zooms_by_wheel_fingers_and_buttons_and_moves_by_dragging(browser, report):
    page = opened(browser, report)
    if page is None:
        return
    page.run("document.querySelector('.map').scrollIntoView({ block: 'center' })")
    left, top, _ = page.run(BOX.format(".chart-map"))
    before = np.array(page.run(PLACES))
    scale = page.run("missions.get('m0').map.scale")
    x, y = before[1]
    page.mouse("mouseWheel", left + x, top + y, deltaX=0, deltaY=-300)
    page.settle()
    zoomed = np.array(page.run(PLACES))
    factor = page.run("missions.get('m0').map.scale") / scale
    assert factor > 1.2
    assert zoomed[1] == pytest.approx(before[1], abs=1.5), "what is under the pointer stays there"
    assert zoomed[0] - zoomed[1] == pytest.approx((before[0] - before[1]) * factor, abs=2)
    for kind, dx in (("mousePressed", 0), ("mouseMoved", 60), ("mouseReleased", 60)):
        page.mouse(kind, left + 200 + dx, top + 300, button="left", buttons=1, clickCount=1)
    assert np.array(page.run(PLACES)) - zoomed == pytest.approx(np.tile([60.0, 0.0], (3, 1)), abs=1)
    scale = page.run("missions.get('m0').map.scale")
    page.touch("touchStart", [(left + 300, top + 200), (left + 400, top + 200)])
    page.touch("touchMove", [(left + 250, top + 200), (left + 450, top + 200)])
    page.touch("touchEnd", [])
    assert page.run("missions.get('m0').map.scale") == pytest.approx(2 * scale, rel=0.1)
    page.run("document.querySelector('[data-zoom=all]').click()")
    whole = page.run("missions.get('m0').map.scale")
    page.run("document.querySelector('[data-zoom=animals]').click()")
    assert page.run("missions.get('m0').map.scale") > whole


def test_every_picture_is_decoded_and_shows_something(browser, report):
    page = opened(browser, report)
    if page is None:
        return
    n_shown, looked = page.run(LOOK_AT_PICTURES)
    assert n_shown >= 3 + 3, "a best picture of each animal, and each camera's"
    assert len(looked) > 60
    widths, heights, spreads = np.array(looked).T
    assert (widths > 0).all()
    assert (heights > 0).all()
    assert np.percentile(spreads, 25) >= 5, "what was taken in the air is not blank"


@pytest.mark.parametrize("width", [WIDE, 820, NARROW])
def test_nothing_runs_over_the_edge(browser, report, width):
    page = opened(browser, report, width)
    if page is None:
        return
    page.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    assert page.run("document.documentElement.scrollWidth") <= width
    beyond = page.run(
        f"""[...document.querySelectorAll("main *")].filter((one) => !one.closest(".wide, .cameras, svg, .bar") && one.getBoundingClientRect().right > {width} + 1).map((one) => one.className || one.tagName)"""  # noqa: E501
    )
    assert beyond == []


@pytest.mark.parametrize("dark", [False, True])
def test_its_words_can_be_read_by_day_and_in_the_dark(browser, report, dark):
    page = opened(browser, report, dark=dark)
    if page is None:
        return
    page.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    ground = page.run("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", ground)[:3])) < 150) == dark
    ratio, text = page.run(CONTRAST)
    assert ratio >= 3.0, text


def test_it_prints_its_words_and_not_its_buttons(browser, report, tmp_path):
    page = opened(browser, report, dark=True)
    if page is None:
        return
    assert page.pdf(tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")
    page.call("Emulation.setEmulatedMedia", media="print")
    hidden = (
        "['.play', '.time', '.zoom'].map((name) => getComputedStyle(document.querySelector(name)).display)"
    )
    assert page.run(hidden) == ["none"] * 3
    assert page.run("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"


def test_hostile_names_run_nothing(browser, tmp_path):
    class HostileRun(MappedRun):
        def _mission_state(self, drone: int, t_s: float) -> Any:
            state = super()._mission_state(drone, t_s)
            state.reason = HOSTILE
            return state

    folder = HostileRun(duration_s=16, monitor_s=(5, 12)).write(tmp_path / "<svg onload=alert(3)>")
    (folder / "mission.json").write_text(json.dumps({"name": HOSTILE}))
    page = opened(browser, make_report(folder))
    if page is None:
        return
    assert page.run("document.querySelectorAll('script').length") == 2
    assert page.run("document.querySelectorAll('img[onerror], svg[onload]').length") == 0
    assert not [event for event in page.events if event["method"] == "Page.javascriptDialogOpening"]
    assert page.run("document.querySelector('.kicker').textContent").startswith("</script><script>alert(1)")
    assert page.run(INJECTION) is None, "the page's policy runs no script that was put into it"


def test_a_day_from_logs_alone_has_a_map_for_each_mission(browser, tmp_path):
    runs = [
        logs_only(tmp_path / name, MappedRun(duration_s=16, monitor_s=(5, 12), n_drones=n))
        for name, n in (("morning", 2), ("evening", 3))
    ]
    flights = [read_flight([folder]) for folder in runs]
    page = opened(browser, write_report(flights, tmp_path / "day.html"))
    if page is None:
        return
    assert page.run("document.querySelector('h1').textContent") == "Two missions: two cannot be judged."
    assert page.run("[...missions.values()].map((one) => one.map.drones.length)") == [2, 3]
    assert page.run("[...missions.values()].map((one) => one.map.animals.length)") == [5, 5]
    before = page.run("missions.get('m1').t")
    slide_to(page, 3.0)
    assert page.run("[...missions.values()].map((one) => one.t)") == [3, before], "each has a time of its own"
