"""Large pictures in tiles: where they are cut, what counts in each, and every animal once."""

import os
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from procs.detector.decode import Candidates
from procs.detector.tiles import SeenLength, Tile, merge, owned, pieces, plan, shortfall
from procs.detector.yolo import Detections, Detector
from tests.unit.detector_networks import NAMES, blob_network, network, raw

INPUT = (320, 320)
DATA = Path(os.environ.get("PODWATCH_REAL_DATA", Path(__file__).parents[3] / "shared" / "data"))


@settings(deadline=None, max_examples=60)
@given(st.integers(40, 4000), st.integers(40, 4000), st.sampled_from([64, 100, 320, "auto"]))
def test_tiles_cover_the_picture_and_share_a_quarter(width: int, height: int, tile: int) -> None:
    tiles = plan((width, height), tile, INPUT)
    if not tiles:
        return
    for near, far, length in ((0, 2, width), (1, 3, height)):
        spans = sorted({(one.window[near], one.window[far]) for one in tiles})
        assert spans[0][0] == 0
        assert spans[-1][1] == length
        side = max(last - first for first, last in spans)
        assert all(first[1] - second[0] >= 0.25 * side - 2 for first, second in pairwise(spans))
        cores = sorted({(one.core[near], one.core[far]) for one in tiles})
        assert cores[0][0] == -np.inf
        assert cores[-1][1] == np.inf
        assert all(first[1] == second[0] for first, second in pairwise(cores)), "no gap, no overlap"


def test_auto_cuts_only_where_an_animal_would_be_too_small() -> None:
    """A picture of 1920 px shrinks six times: 96 px are 16 px at the network's size."""
    assert plan((1920, 1080), "auto", INPUT, 96.0) == []
    tiles = plan((1920, 1080), "auto", INPUT, 90.0)
    sides = {one.window[2] - one.window[0] for one in tiles}
    assert len(sides) == 1
    assert 90.0 / (sides.pop() / 320) >= 23.9, "tiles show it as large as wanted"
    assert plan((640, 480), "auto", INPUT) == [], "nobody knows, and the picture shrinks by two"
    assert plan((1920, 1080), "auto", INPUT) != [], "nobody knows, and the picture shrinks by six"
    assert plan((1920, 1080), None, INPUT, 10.0) == []


@pytest.mark.parametrize("most", [-1, 0, 1, 2, 3, 5, 8, 13, 40])
def test_auto_never_takes_more_tiles_than_there_is_time_for(most: int) -> None:
    for animal_px in (5.0, 20.0, 60.0, None):
        tiles = plan((3840, 2160), "auto", INPUT, animal_px, most)
        assert len(tiles) <= max(most, 0)
        shrink = (tiles[0].window[2] - tiles[0].window[0]) / 320 if tiles else 12.0
        assert not tiles or shrink <= 12.0 / 1.2, "tiles that show nothing larger are not looked at"


@pytest.mark.parametrize("size", [(4000, 3000), (3000, 4000), (1280, 720), (20000, 60), (33, 33)])
def test_no_number_cuts_a_picture_into_more_than_64(size: tuple[int, int]) -> None:
    tiles = plan(size, 32, INPUT)
    assert (2 if size == (33, 33) else 30) < len(tiles) <= 64
    said = shortfall(tiles, size, 32, INPUT, None)
    side = tiles[0].window[2]
    if size == (33, 33):
        assert (side, said) == (32, "")
        return
    assert (
        f"tile = 32: more than 64 tiles in a picture of {size[0]} x {size[1]} px; they are {side} px" in said
    )
    assert plan(size, side, INPUT) == tiles
    assert shortfall(tiles, size, side, INPUT, None) == ""


def test_animals_that_stay_too_small_are_told_and_hopeless_ones_cost_no_time() -> None:
    """Seven looks at 3840 x 2160 px are six tiles that show 20 px as 4, 60 px as 12, 100 px as 21."""
    size = (3840, 2160)
    for animal_px, n_tiles, words in (
        (20.0, 0, "with 0 tiles animals are 2 px long to the network"),
        (60.0, 6, "with 6 tiles animals are 12 px long to the network, which misses them below 16"),
        (100.0, 6, ""),
        (None, 6, ""),
    ):
        tiles = plan(size, "auto", INPUT, animal_px, 7)
        said = shortfall(tiles, size, "auto", INPUT, animal_px)
        assert (len(tiles), bool(said)) == (n_tiles, bool(words)), (animal_px, said)
        assert words in said
    assert shortfall([], size, None, INPUT, 20.0) == "", "who switched it off knows"


def test_tiles_have_the_proportions_of_the_networks_input() -> None:
    tiles = plan((1920, 1080), "auto", (640, 384), 30.0)
    left, top, right, bottom = tiles[0].window
    assert (right - left) / (bottom - top) == pytest.approx(640 / 384, rel=0.01)


def candidates(*boxes: tuple[float, float, float, float], score: float = 0.9) -> Candidates:
    count = len(boxes)
    table = np.array(boxes, np.float32).reshape(-1, 4)
    return Candidates(table, np.full(count, score, np.float32), np.zeros(count, np.int64))


def test_a_tile_counts_what_is_whole_and_in_its_core() -> None:
    """Two tiles of 100 px share 25 px; the border between them is at 87.5."""
    first = Tile((0, 0, 100, 100), (-np.inf, -np.inf, 87.5, np.inf))
    second = Tile((75, 0, 175, 100), (87.5, -np.inf, np.inf, np.inf))
    found = candidates((0, 10, 20, 30), (78, 10, 88, 30), (85, 40, 95, 60), (90, 70, 100, 90))
    assert owned(found, first, (175, 100), 0.5).boxes[:, 0].tolist() == [0, 78]
    assert owned(found, second, (175, 100), 0.5).boxes[:, 0].tolist() == [85, 90]


def test_one_animal_seen_twice_is_one_and_two_side_by_side_stay_two() -> None:
    # Side by side and aslant: their upright boxes overlap by half.
    pair = candidates((10, 10, 50, 50), (20, 20, 60, 60))
    again = candidates((12, 11, 51, 50), (21, 19, 62, 61), (100, 100, 120, 120))
    assert merge([pair, again]).boxes[:, 0].tolist() == [10, 20, 100]
    assert len(merge([candidates((10, 10, 50, 50)), pair]).boxes) == 2, "one known, one new beside it"
    calf = candidates((30, 30, 44, 44))  # within its mother's box
    assert len(merge([pair, calf]).boxes) == 3


def test_a_piece_lies_in_a_large_animal_that_the_whole_picture_shows() -> None:
    """Tiles of 100 px: an animal of 80 px is large, a calf of 20 px is not."""
    whole = candidates((10, 10, 90, 50), (30, 20, 50, 35))
    found = candidates((8, 12, 45, 48), (29, 19, 51, 36), (80, 10, 110, 50), (10, 60, 90, 90))
    assert pieces(found, whole, 100).tolist() == [True, False, False, False]
    assert pieces(found, whole, 200).tolist() == [False] * 4, "no animal is large for such tiles"
    assert pieces(found, candidates(), 100).tolist() == [False] * 4
    boats = whole._replace(classes=np.ones(2, np.int64))
    assert pieces(found, boats, 100).tolist() == [False] * 4, "a whale beside a boat"


def test_a_length_is_learnt_doubted_and_forgotten() -> None:
    seen = SeenLength()
    assert seen.ask() is None
    seen.see(np.array([[0, 0, 10, 30], [0, 0, 40, 10]], np.float32))
    said = [seen.ask() for _ in range(9)]
    assert said.count(None) == 1, "now and then it looks for smaller ones"
    assert said[0] == pytest.approx(32.5)
    for _ in range(26):
        seen.see(np.zeros((0, 4), np.float32))
    assert [seen.ask() for _ in range(3)] == [None] * 3


def test_tiling_finds_in_tiles_and_reports_in_the_whole_picture(tmp_path: Path) -> None:
    # The network always sees a box in the middle of what it is shown: once for the whole and once a tile.
    model = network(tmp_path / "raw.onnx", raw((32, 32, 10, 10, 0.9)))
    picture = np.random.default_rng(2).integers(0, 255, (64, 112, 3), dtype=np.uint8)
    assert len(Detector(model).detect(picture)) == 1
    found = Detector(model, tile=64).detect(picture)
    middles = sorted(((found.boxes[:, 0] + found.boxes[:, 2]) / 2).round(3).tolist())
    assert middles == [32.0, 56.0, 80.0]
    assert found.n_looks == 3


def test_how_near_the_cut_a_box_may_end_is_told_by_the_side_that_shrinks_more(tmp_path: Path) -> None:
    """Tiles of 640 x 640 px at 640 x 384 shrink by 5 / 3: 4 px of the input are 6.7 px of the picture, so
    what ends 5 px before the cut is a piece. The second tile ends with the picture, where nothing is cut.
    """
    box = raw((462.5, 192, 93, 60, 0.9))  # 480 to 635 px in a tile: its centre is the first tile's own
    model = network(tmp_path / "raw.onnx", box, {**NAMES, "imgsz": "[384, 640]"}, shape=(1, 3, 384, 640))
    picture = np.random.default_rng(2).integers(0, 255, (640, 1120, 3), dtype=np.uint8)
    found = Detector(model, tile=640).detect(picture)
    assert found.n_looks == 3
    assert sorted(found.boxes[:, 0].round().tolist()) == [728, 960], "the whole picture's, the second tile's"


def seen_at(detector: Detector, boxes: list[tuple[int, int, int, int]], size: tuple[int, int]) -> Detections:
    """What is found where (left, top, right, bottom) are bright, one in each colour, on a dim sea."""
    picture = np.random.default_rng(3).integers(0, 60, (size[1], size[0], 3), dtype=np.uint8)
    for channel, (left, top, right, bottom) in zip((2, 1, 0), boxes, strict=False):
        picture[top:bottom, left:right, channel] = 255
    return detector.detect(picture)


@pytest.mark.parametrize("tile", [192, "auto"])
def test_an_animal_on_the_seam_is_one_and_whole_at_every_offset(tmp_path: Path, tile: int | str) -> None:
    """24 x 10 px in a picture of 640 x 480: it crosses every seam and every border of two cores."""
    detector = Detector(blob_network(tmp_path / "blobs.onnx", side=160), tile=tile, look_ms=1.0)
    detector.animal_px = 24.0
    for step in range(0, 610, 5):
        left, top = step, (7 * step) % 465
        box = (left, top, left + 24, top + 10)
        found = seen_at(detector, [box], (640, 480))
        assert found.n_looks > 12
        assert len(found) == 1, (box, found.boxes)
        assert np.abs(found.boxes[0] - box).max() <= 2.5, (box, found.boxes)


def test_three_animals_that_touch_on_a_seam_stay_three(tmp_path: Path) -> None:
    detector = Detector(blob_network(tmp_path / "blobs.onnx"), tile=96)
    for left in range(50, 130, 4):
        boxes = [
            (left, 100, left + 24, 110),
            (left + 2, 110, left + 26, 120),
            (left + 25, 104, left + 49, 114),
        ]
        found = seen_at(detector, boxes, (400, 300))
        assert len(found) == 3, (left, found.boxes)
        given = np.array(sorted(boxes))
        assert np.abs(np.array(sorted(found.boxes.tolist())) - given).max() <= 2.5


def test_an_animal_larger_than_a_tile_is_found_in_the_whole(tmp_path: Path) -> None:
    detector = Detector(blob_network(tmp_path / "blobs.onnx"), tile=96)
    found = seen_at(detector, [(40, 60, 300, 200)], (400, 300))
    assert len(found) == 1
    assert np.abs(found.boxes[0] - (40, 60, 300, 200)).max() <= 6  # a network's pixel is six of the picture


@pytest.mark.parametrize("length", [50, 70, 110, 180])
def test_a_large_animal_is_one_where_a_network_boxes_its_ends_by_themselves(
    tmp_path: Path, length: int
) -> None:
    """Boxes four fifths as long as what a tile shows end far from the cut, as those of a whole animal do."""
    detector = Detector(blob_network(tmp_path / "blobs.onnx", share=0.8), tile=96)
    for left in range(0, 400 - length, 10):
        box = (left, 100, left + length, 100 + length // 3)
        found = seen_at(detector, [box], (400, 300))
        assert len(found) == 1, (box, found.boxes)
        assert found.boxes[0, 2] - found.boxes[0, 0] == pytest.approx(0.8 * length, abs=8), box


def test_a_small_animal_over_a_large_one_stays(tmp_path: Path) -> None:
    """The whole picture shows both; where a tile shows the small one too, it shows it larger."""
    detector = Detector(blob_network(tmp_path / "blobs.onnx", share=0.8), tile=96)
    for left in range(70, 200, 10):
        mother, calf = (40, 60, 300, 200), (left, 110, left + 30, 125)
        found = seen_at(detector, [mother, calf], (400, 300))
        assert len(found) == 2, (calf, found.boxes)
        small = found.boxes[np.argmin(found.boxes[:, 2] - found.boxes[:, 0])]
        assert np.abs(small - (left + 3, 111.5, left + 27, 123.5)).max() <= 2.5, (calf, small)


def n_inside(boxes: np.ndarray, large: np.ndarray) -> int:
    """How many boxes lie more than half in a large one."""
    shared = np.minimum(boxes[:, 2:], large[2:]) - np.maximum(boxes[:, :2], large[:2])
    sizes = boxes[:, 2:] - boxes[:, :2]
    return int(np.sum(np.clip(shared, 0, None).prod(axis=1) > 0.5 * sizes.prod(axis=1)))


def test_no_head_or_tail_of_a_photographed_whale_counts_by_itself() -> None:
    """Right whales half a picture long, in tiles that show most of them in parts."""
    photographs = sorted((DATA / "right_whales" / "images").glob("*.jpg"))[:20]
    if not photographs:
        pytest.skip("needs ../shared/data/right_whales")
    whole, tiled = Detector(), Detector(tile=400)
    n_large = 0
    for path in photographs:
        picture = cv2.imread(str(path))
        boxes, expected = tiled.detect(picture).boxes, whole.detect(picture).boxes
        for large in expected[(expected[:, 2:] - expected[:, :2]).max(axis=1) > 240]:
            n_large += 1
            assert n_inside(boxes, large) <= n_inside(expected, large), path.name
    assert n_large > len(photographs) / 2


def test_auto_learns_from_the_boxes_how_large_animals_are(tmp_path: Path) -> None:
    """Shrunk six times a blob of 30 px is 5 px: seen, and too small, so the next picture is cut."""
    detector = Detector(blob_network(tmp_path / "blobs.onnx"), tile="auto", look_ms=1.0)
    large = [seen_at(detector, [(40, 60, 190, 120)], (384, 288)).n_looks for _ in range(3)]
    assert large[0] > 1, "nobody knows yet"
    assert large[1:] == [1, 1]
    detector = Detector(blob_network(tmp_path / "blobs.onnx"), tile="auto", look_ms=1.0)
    small = [seen_at(detector, [(40, 60, 70, 80)], (384, 288)).n_looks for _ in range(3)]
    assert min(small) > 1


def test_auto_stays_within_its_time(tmp_path: Path) -> None:
    model = blob_network(tmp_path / "blobs.onnx")
    for limit_ms, most in ((1000.0, 65), (100.0, 10), (25.0, 2), (10.0, 1)):
        detector = Detector(model, tile="auto", tile_limit_ms=limit_ms, look_ms=10.0)
        detector.animal_px = 20.0
        found = seen_at(detector, [(40, 60, 60, 70)], (640, 480))
        assert 1 <= found.n_looks <= most
        assert "misses them below 16; fly lower, or raise tile_limit_ms" in found.trouble
