"""Samples keep boxes on their animals, whatever is done to the picture; what is read from disk is checked."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tools.errors import UnusableError
from tools.render import Scene
from tools.train.detector import samples
from tools.train.detector.labels import read_labels
from tools.train.detector.own import own_pictures
from tools.train.detector.photographs import _pasted, _picked, _window, empty_seas, photograph_sample
from tools.train.detector.pictures import photographs
from tools.train.detector.samples import (
    SCENES_VERSION,
    Sample,
    augment,
    cached_scenes,
    held_out,
    letterboxed,
    numbered,
    read_yolo,
    scene_sample,
)


def test_files_are_ordered_by_number_and_every_fifth_is_held_out() -> None:
    paths = [Path(f"w_{number}.jpg") for number in (10, 2, 1, 11, 3, 0)]
    assert [path.stem for path in sorted(paths, key=numbered)] == ["w_0", "w_1", "w_2", "w_3", "w_10", "w_11"]
    kept, out = held_out(paths)
    assert [path.stem for path in out] == ["w_0", "w_11"]
    assert not set(kept) & set(out)


def test_no_held_out_photograph_is_learnt_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures_in(tmp_path / "right_whales", 11)
    for path in (tmp_path / "right_whales" / "images" / "train").iterdir():
        cv2.imwrite(str(tmp_path / "right_whales" / "images" / f"w_{path.stem}.jpg"), cv2.imread(str(path)))
    monkeypatch.setenv("PODWATCH_REAL_DATA", str(tmp_path))
    _, out = held_out(sorted((tmp_path / "right_whales" / "images").glob("*.jpg")))
    assert {path.stem for path in out} == {"w_0", "w_5", "w_10"}
    learnt = {photo.name for photo in photographs()}
    assert learnt == {f"w_{number}" for number in range(11)} - {path.stem for path in out}


def test_a_picture_of_no_use_is_named(tmp_path: Path) -> None:
    (tmp_path / "b.jpg").write_text("no picture")
    with pytest.raises(UnusableError, match=r"b\.jpg: not a picture"):
        read_yolo([tmp_path / "b.jpg"], tmp_path)
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((31, 90, 3), np.uint8))
    with pytest.raises(UnusableError, match=r"a\.png: 90x31 px.*32"):
        read_yolo([tmp_path / "a.png"], tmp_path)


def test_labels_are_boxes_or_polygons_with_or_without_blank_lines_and_a_byte_order_mark(
    tmp_path: Path,
) -> None:
    label = tmp_path / "a.txt"
    assert read_labels(label, (200, 100)).shape == (0, 5), "no file, no animal"
    label.write_text("\ufeff0 0.5 0.5 0.2 0.4\n\n1 0.1 0.2 0.3 0.2 0.2 0.6\n  \n", encoding="utf-8")
    boxes = [[80, 30, 120, 70, 1], [20, 20, 60, 60, 1]]
    np.testing.assert_allclose(read_labels(label, (200, 100)), boxes, atol=1e-4)
    np.testing.assert_allclose(read_labels(label, (200, 100), {0: False, 1: True}), boxes[1:], atol=1e-4)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0 0.5 0.5 0.2", "neither"),
        ("0 0.5 0.5 0.2 0.2 0.9", "neither"),
        ("0 0.5 0.5 wide 0.2", "no number"),
        ("0.5 0.5 0.5 0.2 0.2", "class 0.5"),
        ("nan 0.5 0.5 0.2 0.2", "class nan"),
        ("7 0.5 0.5 0.2 0.2", "class 7 is none of the data set's: 0"),
        ("0 0.5 0.5 0 0", "under 1 px"),
        ("0 0.5 0.5 0.2 0.001", "under 1 px"),
        ("0 0.1 0.1 0.1 0.1 0.1 0.1", "under 1 px"),
        ("0 0.5 0.5 nan 0.2", "shares"),
        ("0 0.5 0.5 inf 0.2", "shares"),
        ("0 0.5 0.5 -0.2 0.2", "shares"),
        ("0 120 80 40 20", "shares"),
    ],
)
def test_a_label_of_no_use_is_refused_with_its_file_and_line(tmp_path: Path, line: str, message: str) -> None:
    (tmp_path / "a.txt").write_text(f"0 0.5 0.5 0.2 0.4\n{line}\n")
    with pytest.raises(UnusableError, match=rf"a\.txt: line 2 '{line}': .*{message}"):
        read_labels(tmp_path / "a.txt", (200, 100), {0: True})


LIGHTEST_WATER = 40


def marked(seed: int, width: int, height: int) -> Sample:
    """Dark noise, the water, with one white rectangle, which is the animal."""
    rng = np.random.default_rng(seed)
    image = rng.integers(0, LIGHTEST_WATER, (height, width, 3), dtype=np.uint8)
    x, y, w, h = (
        int(rng.integers(0, width - 60)),
        int(rng.integers(0, height - 40)),
        50,
        int(rng.integers(12, 34)),
    )
    image[y : y + h, x : x + w] = 255
    half = Sample(
        np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8),
        np.array([[x / 2, y / 2, (x + w) / 2, (y + h) / 2, 1]], np.float32),
    )
    return Sample(image, np.array([[x, y, x + w, y + h, 1]], np.float32), half)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.booleans())
def test_samples_keep_boxes_on_their_animals(seed: int, rendered: bool) -> None:
    rng = np.random.default_rng(seed)
    photos = [marked(seed + k, 240, 160) for k in range(3)]
    empty = [Sample(np.full((96, 96, 3), 20, np.uint8), np.zeros((0, 5), np.float32))]
    sample = scene_sample(photos[0], rng, 96) if rendered else photograph_sample(photos, empty, rng, 96)
    if rng.random() < 0.3:
        sample = letterboxed(sample, rng)
    assert sample.image.shape == (96, 96, 3)
    for box in sample.boxes[sample.boxes[:, 4] > 0]:
        left, top, right, bottom = box[:4]
        assert 0 <= left < right <= 96
        assert 0 <= top < bottom <= 96
        x0, y0, x1, y1 = int(left + 2), int(top + 2), int(right - 1), int(bottom - 1)
        if x1 - x0 >= 2 and y1 - y0 >= 2:
            assert np.median(sample.image[y0:y1, x0:x1]) > 1.25 * LIGHTEST_WATER


def test_any_of_several_animals_is_pasted_and_its_neighbours_keep_their_boxes() -> None:
    photo = Sample(np.full((160, 240, 3), 20, np.uint8), np.zeros((0, 5), np.float32))
    corners = [(30, 60), (90, 60), (90, 84)]  # the last two nearly touch
    for x, y in corners:
        photo.image[y : y + 22, x : x + 50] = 255
    photo = replace(photo, boxes=np.array([[x, y, x + 50, y + 22, 1] for x, y in corners], np.float32))
    for seed in range(60):
        pasted = _pasted([photo], [], np.random.default_rng(seed), 160)
        unlabelled = pasted.image.max(axis=2) > 60
        for left, top, right, bottom in pasted.boxes[:, :4].astype(int):
            unlabelled[max(top - 2, 0) : bottom + 3, max(left - 2, 0) : right + 3] = False
        assert not unlabelled.any(), seed
    halved = replace(photo, half=replace(photo, boxes=photo.boxes / 2))
    picked = [_picked([halved], np.random.default_rng(seed)) for seed in range(20)]
    assert {tuple(each.boxes[0, :2]) for each in picked} == set(corners)
    assert all(each.half is not None and (each.half.boxes == each.boxes / 2).all() for each in picked)


def test_an_enlarged_photograph_fills_its_window_to_the_rim() -> None:
    photo = Sample(np.full((150, 210, 3), 200, np.uint8), np.zeros((0, 5), np.float32))
    for seed in range(20):
        window = _window(photo, np.random.default_rng(seed), (320, 320), 60.0)
        assert (window.image == 200).all(), "nothing is left to what lay in memory before"


def test_augmentation_keeps_the_shape_and_repeats_for_the_same_generator() -> None:
    image = marked(0, 64, 48).image[:48, :64]
    for seed in range(30):
        one, same = (augment(image, np.random.default_rng(seed)) for _ in range(2))
        assert one.shape == image.shape
        assert one.dtype == np.uint8
        np.testing.assert_array_equal(one, same)


def test_a_cache_that_was_cut_off_is_made_again(tmp_path: Path) -> None:
    first = cached_scenes(tmp_path, 2, 3, "train", tmp_path / "no_outlines.csv")
    (tmp_path / f"train_3_2_v{SCENES_VERSION}.boxes.npz").unlink()  # written last, so a killed run has none
    again = cached_scenes(tmp_path, 2, 3, "train", tmp_path / "no_outlines.csv")
    for one, same in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.image, same.image)
        np.testing.assert_array_equal(one.boxes, same.boxes)


def test_two_trainings_that_begin_together_make_the_same_scenes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, others = samples.scenes, []

    def meanwhile(*words: object, **more: object) -> Iterator[Scene]:
        """The other training begins while this one renders, and ends first."""
        monkeypatch.setattr(samples, "scenes", made)
        with monkeypatch.context() as patch:
            patch.setattr("os.getpid", lambda: -1)
            others.extend(cached_scenes(tmp_path, 2, 3, "train", tmp_path / "no_outlines.csv"))
        yield from made(*words, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(samples, "scenes", meanwhile)
    ours = cached_scenes(tmp_path, 2, 3, "train", tmp_path / "no_outlines.csv")
    for one, same in zip(ours, others, strict=True):
        np.testing.assert_array_equal(one.image, same.image)
    assert not list(tmp_path.glob("*.part"))


def test_the_water_beside_an_animal_is_an_empty_sea_and_a_narrow_rim_is_none() -> None:
    wide = Sample(np.full((400, 900, 3), 50, np.uint8), np.array([[60, 100, 300, 200, 1]], np.float32))
    wide.image[100:200, 60:300] = 250
    filled = Sample(wide.image[:300, :320], wide.boxes)
    (sea,) = empty_seas([wide, filled])
    assert sea.shape == (400, 575, 3)
    assert (sea == 50).all()


def test_rendered_animals_swim_on_a_photograph_of_water(tmp_path: Path) -> None:
    photograph = np.full((300, 500, 3), (90, 20, 140), np.uint8)
    samples = cached_scenes(tmp_path, 3, 0, "train", tmp_path / "none.csv", [photograph])
    for sample in samples:
        assert np.median(sample.image.reshape(-1, 3), axis=0).tolist() == [90, 20, 140]
    assert sum(len(sample.boxes) for sample in samples) > 2
    assert len(list(tmp_path.glob("train_on_photographs_0_3_*"))) == 2


def pictures_in(folder: Path, count: int, images: str = "images/train", kind: int = 0) -> None:
    """`count` grey pictures of 60x40 px, each with one box of class `kind`, in the YOLO layout."""
    labels = images.replace("images", "labels")
    for name in (images, labels):
        (folder / name).mkdir(parents=True)
    for index in range(count):
        cv2.imwrite(str(folder / images / f"{index}.png"), np.full((40, 60, 3), 90, np.uint8))
        (folder / labels / f"{index}.txt").write_text(f"{kind} 0.5 0.5 0.2 0.4\n")


@pytest.mark.parametrize(
    "text",
    [
        "path: .\ntrain: images/train\nnames:\n  0: whale\n",
        "train: 'images/train'  # mine\nval: images/train\nnc: 1\n",
        "---\ntrain: [images/train]\nnames: ['whale']\n",
        "train:\n  - images/train\nnames: [\n  whale  # all of them\n]\ndownload: |\n  import os\n",
        "path: sub/..\ntrain: list.txt\nnames:\n- whale\n",
        "{path: ., train: images/train, names: {0: whale}}",
        "\ufefftrain: images\nnames: {0: whale}\n",
        "names:\n- 'whale'\nnc: 1\ntrain: ../images/train\nval: ../valid/images\n",
    ],
)
def test_own_pictures_are_found_however_the_data_file_names_them(tmp_path: Path, text: str) -> None:
    pictures_in(tmp_path, 2)
    (tmp_path / "sub").mkdir()
    (tmp_path / "list.txt").write_text("images/train/0.png\n\nimages/train/1.png\n")
    (tmp_path / "data.yaml").write_text(text, encoding="utf-8")
    samples = own_pictures(tmp_path / "data.yaml")
    assert len(samples) == 2
    np.testing.assert_allclose(samples[0].boxes, [[24, 12, 36, 28, 1]], atol=1e-5)


def test_own_pictures_may_lie_in_subfolders_and_be_of_other_kinds(tmp_path: Path) -> None:
    pictures_in(tmp_path, 2, "train/images/day/one")
    for suffix in (".webp", ".tif"):
        picture = (tmp_path / "train/images/day/one/1.png").with_suffix(suffix)
        cv2.imwrite(str(picture), np.full((40, 60, 3), 90, np.uint8))
    (tmp_path / "train/images/._0.png").write_text("what other systems leave")
    (tmp_path / "data.yaml").write_text("train: ../train/images\nnames: [whale]\n")
    assert [len(sample.boxes) for sample in own_pictures(tmp_path / "data.yaml")] == [1, 1, 1, 1]


def test_where_there_are_several_classes_somebody_must_say_which_are_whales(tmp_path: Path) -> None:
    pictures_in(tmp_path, 1, kind=0)
    pictures_in(tmp_path, 1, "more/images", kind=1)
    data = tmp_path / "data.yaml"
    data.write_text("train: [images/train, more/images]\nnames: [boat, whale]\n")
    with pytest.raises(UnusableError, match=r"2 classes.*--classes .*0 boat, 1 whale"):
        own_pictures(data)
    for classes in (["whale"], ["1"]):
        assert [len(sample.boxes) for sample in own_pictures(data, classes)] == [0, 1]
    assert [len(sample.boxes) for sample in own_pictures(data, ["boat", "1"])] == [1, 1]
    with pytest.raises(UnusableError, match="no class 'orca'; there are: 0 boat, 1 whale"):
        own_pictures(data, ["orca"])
    data.write_text("train: images/train\nnc: 2\n")
    with pytest.raises(UnusableError, match="2 classes"):
        own_pictures(data)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("names:\n  0: whale\n", "no entry 'train'"),
        ("train: nowhere\nnames: [whale]\n", r"no pictures \(.jpg.*nowhere"),
        ("train: bare/images\nnames: [whale]\n", "none of its 1 pictures has a label file in .*bare/labels"),
        ("train: bare/images\n", "no entry 'names'"),
        ("train: bare/images\nnames: [whale\n", "is no YAML at line 3: expected"),
        ("just words\n", "no mapping of keys to values"),
        ("train: bare/images\nnc: some\n", "nc is 'some'"),
        ("\x89PNG", "is no YAML: .*not allowed"),
    ],
)
def test_a_data_file_of_no_use_is_refused_with_the_remedy(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bare" / "images").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "bare" / "images" / "0.png"), np.full((40, 60, 3), 90, np.uint8))
    (tmp_path / "data.yaml").write_text(text)
    with pytest.raises(UnusableError, match=rf"data\.yaml: .*{message}"):
        own_pictures(tmp_path / "data.yaml")
    with pytest.raises(UnusableError, match=r"none\.yaml: no such file"):
        own_pictures(tmp_path / "none.yaml")
