"""Samples keep boxes on their animals, whatever is done to the picture; what is read from disk is checked."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tools.train.detector.photographs import empty_seas, photograph_sample
from tools.train.detector.pictures import own_pictures
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


def test_a_bad_label_or_picture_is_named(tmp_path: Path) -> None:
    picture = tmp_path / "a.png"
    cv2.imwrite(str(picture), np.zeros((10, 20, 3), np.uint8))
    (tmp_path / "a.txt").write_text("0 0.5 0.5 0.2\n")
    with pytest.raises(ValueError, match=r"a\.txt.*0\.5 0\.5 0\.2"):
        read_yolo([picture], tmp_path)
    (tmp_path / "a.txt").write_text("0 0.5 0.5 0.2 0.4\n")
    np.testing.assert_allclose(read_yolo([picture], tmp_path)[0].boxes, [[8, 3, 12, 7, 1]], atol=1e-5)
    (tmp_path / "b.jpg").write_text("no picture")
    with pytest.raises(ValueError, match=r"b\.jpg"):
        read_yolo([tmp_path / "b.jpg"], tmp_path)


def marked(seed: int, width: int, height: int) -> Sample:
    """Dark noise with one white rectangle, which is the animal."""
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 40, (height, width, 3), dtype=np.uint8)
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
        if x1 - x0 >= 2 and y1 - y0 >= 2:  # the animal is white, the water dark
            assert np.median(sample.image[y0:y1, x0:x1]) > 120


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


def pictures_in(folder: Path, count: int) -> None:
    """`count` grey pictures, each with one box, in the YOLO layout below `folder`."""
    for kind in ("images", "labels"):
        (folder / kind / "train").mkdir(parents=True)
    for index in range(count):
        cv2.imwrite(str(folder / "images" / "train" / f"{index}.png"), np.full((20, 30, 3), 90, np.uint8))
        (folder / "labels" / "train" / f"{index}.txt").write_text("3 0.5 0.5 0.2 0.4\n")


@pytest.mark.parametrize(
    "text",
    [
        "path: .\ntrain: images/train\nnames:\n  0: whale\n",
        "train: 'images/train'  # mine\nval: images/train\nnc: 4\n",
        "train: [images/train]\n",
        "train:\n  - images/train\nnames: [a, b]\n",
        "path: sub/..\ntrain: list.txt\n",
    ],
)
def test_own_pictures_are_found_however_the_data_file_names_them(tmp_path: Path, text: str) -> None:
    pictures_in(tmp_path, 2)
    (tmp_path / "sub").mkdir()
    (tmp_path / "list.txt").write_text("images/train/0.png\n\nimages/train/1.png\n")
    (tmp_path / "data.yaml").write_text(text)
    samples = own_pictures(tmp_path / "data.yaml")
    assert len(samples) == 2
    np.testing.assert_allclose(samples[0].boxes, [[12, 6, 18, 14, 1]], atol=1e-5)


def test_a_data_file_that_names_no_pictures_is_refused_with_the_remedy(tmp_path: Path) -> None:
    for text, message in (("names:\n  0: whale\n", "no entry 'train'"), ("train: nowhere\n", "no JPEG")):
        (tmp_path / "data.yaml").write_text(text)
        with pytest.raises(ValueError, match=message):
            own_pictures(tmp_path / "data.yaml")
    with pytest.raises(ValueError, match="no such file"):
        own_pictures(tmp_path / "none.yaml")
