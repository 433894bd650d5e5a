"""What the renderer can draw does reach the scenes and the trainer: nothing of the list falls out unseen."""

import json
from collections import defaultdict
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.cameras.pinhole import Pinhole, Pose
from drivers.sim.render import AnimalView, SeaRenderer, clutter, renderer
from drivers.sim.render.species import species_named
from tools.render import SPLITS, Scene, render_dataset, scenes
from tools.train.detector import pictures, samples
from tools.train.detector.pictures import Batches, Mixture
from tools.train.detector.samples import Sample, augment

scenes_module = import_module("tools.render.scenes")  # the package's own name of it is the function
EFFECTS = ("blurred", "compressed", "glittering", "hazy", "motion_blurred", "noisy", "vignetted")
CLUTTER = {"_dark_patch", "_streaks", "_foam", "_rock", "_boat", "_log", "_buoy", "_birds"}
TILTED_RAD = 0.36  # no view that looks down is tilted so far
CAMERA, ABOVE = Pinhole((320, 240), np.radians(60)), Pose(0.0, 0.0, -18.0)
Calls = dict[str, list[tuple[Any, ...]]]


def counted(patch: pytest.MonkeyPatch, module: Any, names: tuple[str, ...], calls: Calls) -> None:
    """Note the arguments and the result of every call of a module's functions."""

    def noting(name: str, made: Any) -> Any:
        def noted(*words: Any, **more: Any) -> Any:
            result = made(*words, **more)
            calls[name].append((*words, result))
            return result

        return noted

    for name in names:
        patch.setattr(module, name, noting(name, getattr(module, name)))


@pytest.fixture(scope="module")
def drawn() -> tuple[list[Scene], Calls]:
    """Four dozen small scenes of two seas as `podwatch render` makes them, and what was called for them."""
    calls: Calls = defaultdict(list)
    with pytest.MonkeyPatch.context() as patch:
        counted(patch, scenes_module, (*EFFECTS, "add_clutter", "add_spout", "make_view"), calls)
        names = tuple(draw.__name__ for draw, *_ in clutter.KINDS)
        counted(patch, clutter, names, calls)
        kinds = [(getattr(clutter, draw.__name__), *chances) for draw, *chances in clutter.KINDS]
        patch.setattr(clutter, "KINDS", tuple(kinds))
        patch.setattr(scenes_module, "SCENES_A_SEA", 24)  # a sea's textures and animals take most of the time
        made = list(scenes(48, 1, "train", (96, 72), camera_effects=True))
    return made, calls


def test_every_scene_gets_clutter_of_every_kind_and_some_animals_breathe(
    drawn: tuple[list[Scene], Calls],
) -> None:
    made, calls = drawn
    assert len(calls["add_clutter"]) == len(made)
    assert {name for name in CLUTTER if calls[name]} == CLUTTER
    assert len(calls["add_spout"]) >= 3


def test_every_effect_of_air_sun_and_camera_is_used(drawn: tuple[list[Scene], Calls]) -> None:
    made, calls = drawn
    for name in ("compressed", "noisy", "vignetted"):
        assert len(calls[name]) == len(made), name
    for name in ("blurred", "glittering", "hazy", "motion_blurred"):
        assert 2 <= len(calls[name]) <= 20, name
    for scene, (*_, last) in zip(made, calls["compressed"], strict=True):
        assert scene.image is last
    for name in ("exposure", "noise", "jpeg"):
        assert len({getattr(scene.conditions, name) for scene in made}) > 20, name


def test_one_view_in_five_is_tilted(drawn: tuple[list[Scene], Calls]) -> None:
    pitches = np.array([view[-1][1].pitch_rad for view in drawn[1]["make_view"]])
    assert 0.08 <= (pitches > TILTED_RAD).mean() <= 0.35
    assert pitches.max() > np.radians(35)


def test_one_place_in_seven_is_a_lawn_and_waters_suns_and_seas_vary(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[dict[str, Any]] = []
    monkeypatch.setattr(scenes_module, "SeaRenderer", lambda seed, **more: made.append(more))
    for split, least, most in (("train", 0.09, 0.2), ("val", 0.09, 0.2), ("empty", 0.0, 0.0)):
        made.clear()
        for seed in range(300):
            scenes_module._place(np.random.default_rng(seed), SPLITS[split], seed, None, ())
        assert least <= np.mean([each["kind"] == "grass" for each in made]) <= most, split
        assert {each["water"] for each in made} == set(SPLITS[split].waters)
        for name, largest in (("glint", 1.0), ("sea_state", 5.0), ("sun_elevation_rad", 1.4)):
            values = [each[name] for each in made]
            assert max(values) > 0.9 * largest, name
            assert min(values) < 0.4 * largest, name


def test_whales_on_a_lawn_are_posters_and_whales_at_sea_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    for posters, kind in ((1.0, "grass"), (0.0, "sea")):
        calls: Calls = defaultdict(list)
        with monkeypatch.context() as patch:
            patch.setitem(SPLITS, "train", replace(SPLITS["train"], posters=posters))
            counted(patch, scenes_module, ("draw_and_see",), calls)
            assert {scene.kind for scene in scenes(6, 0, "train", (96, 96))} == {kind}
        animals = [animal for call in calls["draw_and_see"] for animal in call[4]]
        assert len(animals) > 6
        assert all(animal.poster == (kind == "grass") for animal in animals)


def test_a_written_set_shows_what_the_camera_does(tmp_path: Path) -> None:
    render_dataset(tmp_path, 2, 0, "train", (64, 64))
    for path in (tmp_path / "truth" / "train").glob("*.json"):
        conditions = json.loads(path.read_text())["conditions"]
        assert conditions["noise"] > 0
        assert conditions["jpeg"] < 100


def difference(first: SeaRenderer, second: SeaRenderer, *animals: AnimalView) -> np.ndarray:
    """(H, W): how far two renderers' views of the same are apart, grey levels."""
    one, two = (each.render(CAMERA, ABOVE, 0.0, animals).astype(int) for each in (first, second))
    return np.asarray(np.abs(one - two).max(axis=2))


def test_the_sun_glints_on_the_water() -> None:
    sun = {"species": (), "water": "atlantic", "sun_elevation_rad": 1.2}
    with_sun, without = (SeaRenderer(3, glint=glint, **sun) for glint in (1.0, 0.0))  # type: ignore[arg-type]
    changed = difference(with_sun, without)
    assert changed.max() > 40, "a bright patch"
    assert changed.max() > 2 * np.median(changed)


def test_an_animal_at_the_surface_has_a_rim_of_foam_and_a_wake(monkeypatch: pytest.MonkeyPatch) -> None:
    made = renderer.make_foam

    def without_foam(*words: Any) -> Any:
        sprite = made(*words)
        return replace(sprite, levels=tuple(np.zeros_like(level) for level in sprite.levels))

    sea = SeaRenderer(3, species=(), water="atlantic")
    px_per_m = 1 / CAMERA.metres_per_px(ABOVE.height_m)
    rims, wakes = 0, 0
    for identity in range(4):
        animal = AnimalView(identity, 0.0, 0.0, 0.0, 10.0)  # heads north, up
        views = []
        for make in (made, without_foam):
            renderer._cached_sprite.cache_clear()
            monkeypatch.setattr(renderer, "make_foam", make)
            views.append(sea.render(CAMERA, ABOVE, 0.0, [animal]).astype(int))
        v, u = np.nonzero((views[0] - views[1]).max(axis=2) > 20)
        beside_m, behind_m = np.abs(u - 160) / px_per_m, (v - 120) / px_per_m
        rims += int((beside_m[behind_m < 2] > 0.09 * 10).sum())
        wakes += int((behind_m > 5.2).sum())
    renderer._cached_sprite.cache_clear()
    assert rims > 40
    assert wakes > 15


def test_a_sperm_whales_back_is_wrinkled_behind_its_head() -> None:
    smooth = replace(species_named("sperm"), wrinkles=0.0)
    plain = SeaRenderer(3, species=(), water="atlantic")
    other = SeaRenderer(3, species=(), water="atlantic", shapes={"sperm": smooth})
    changed = difference(plain, other, AnimalView(1, 0.0, 0.0, 0.0, 10.0))
    metre_px = 1 / CAMERA.metres_per_px(ABOVE.height_m)
    head_ends = int(120 - (0.5 - 0.3) * 10 * metre_px)
    assert changed[:head_ends].max() <= 3
    assert (changed[head_ends:] > 3).sum() > 100


@pytest.fixture
def small_batches(monkeypatch: pytest.MonkeyPatch) -> Batches:
    """Batches of eight pictures of three grey seas."""
    rng = np.random.default_rng(0)
    made = [
        Sample(rng.integers(80, 90, (96, 96, 3), dtype=np.uint8), np.zeros((0, 5), np.float32))
        for _ in range(3)
    ]
    monkeypatch.setattr(pictures, "photographs", list)
    monkeypatch.setattr(pictures, "_rendered", lambda *_, **__: made)
    return Batches(Mixture(batch=8, side=64), Path("unused"))


def test_the_trainer_adds_clutter_to_half_of_its_pictures_and_bars_to_some(
    small_batches: Batches, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: Calls = defaultdict(list)
    counted(monkeypatch, pictures, ("add_clutter", "augment", "letterboxed"), calls)
    for step in range(8):
        small_batches[step]
    assert len(calls["augment"]) == 64
    assert 20 <= len(calls["add_clutter"]) <= 44
    assert 15 <= len(calls["letterboxed"]) <= 40


def test_the_trainer_uses_every_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: Calls = defaultdict(list)
    counted(monkeypatch, samples, EFFECTS, calls)
    for seed in range(200):
        augment(np.full((32, 32, 3), 90, np.uint8), np.random.default_rng(seed))
    for name in EFFECTS:
        assert 4 <= len(calls[name]) <= 100, name
