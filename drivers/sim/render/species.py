"""Proportions and colours of the animals, as a small table: all lengths are shares of the body length.

The body runs from the tip of the snout (station 0) to the notch between the flukes (station 1). Widths were
set from published photogrammetry and field guides; the minke's are the 19 widths that come with the
photogrammetry example of MorphoMetriX. Training may replace the right whale's by measured outlines
(tools/render/outlines.py).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "MORE_SPECIES",
    "SPECIES",
    "Species",
    "body_outline",
    "fin_outlines",
    "fluke_outline",
    "species_named",
    "with_widths",
]

Array = NDArray[np.float64]

# Stations along the body at which the widths are given.
STATIONS = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.97, 1.0])


@dataclass(frozen=True)
class Species:
    """Shape and look of one species. Colours are BGR, 0 to 255."""

    name: str
    widths: tuple[float, ...]  # full width at each station
    fluke_span: float
    fluke_chord: float
    fluke_sweep: float  # how far the tips lie behind the leading edge's root
    fin_station: float  # where the pectoral fins leave the body
    fin_length: float
    fin_chord: float
    dorsal_station: float  # 0 means no dorsal fin
    dorsal_height: float
    back_bgr: tuple[int, int, int]
    patch_bgr: tuple[int, int, int]  # callosities, scars, mottling
    head_patches: float  # share of the head covered by light patches
    mottling: float  # strength of light blotches over the whole body, 0 to 1
    wrinkles: float  # strength of the lengthwise wrinkles behind the head, 0 to 1
    length_m: float  # a typical adult
    # Share of the opacity lost at the snout and at the flukes: it hangs in the water head or tail down.
    head_under: float = 0.0
    tail_under: float = 0.0


SPECIES: dict[str, Species] = {
    item.name: item
    for item in (
        # A square head of a third of the body, a low hump far back, broad triangular flukes.
        Species(
            "sperm",
            (0.075, 0.105, 0.122, 0.132, 0.142, 0.156, 0.172, 0.168, 0.142, 0.104, 0.066, 0.038, 0.034, 0.03),
            *(0.27, 0.105, 0.085, 0.33, 0.085, 0.05, 0.66, 0.03),
            *((74, 76, 82), (128, 132, 138), 0.05, 0.25, 1.0, 11.0),
        ),
        # Very broad, no dorsal fin, white callosities on the head.
        Species(
            "right",
            (0.03, 0.06, 0.095, 0.145, 0.205, 0.24, 0.245, 0.225, 0.18, 0.125, 0.075, 0.042, 0.035, 0.03),
            *(0.36, 0.115, 0.1, 0.24, 0.14, 0.085, 0.0, 0.0),
            *((48, 50, 54), (190, 198, 202), 0.45, 0.1, 0.1, 13.0),
        ),
        # Long white-edged pectoral fins.
        Species(
            "humpback",
            (0.03, 0.065, 0.1, 0.14, 0.185, 0.21, 0.215, 0.195, 0.155, 0.108, 0.065, 0.038, 0.034, 0.03),
            *(0.33, 0.11, 0.1, 0.26, 0.3, 0.07, 0.62, 0.03),
            *((52, 50, 48), (185, 190, 190), 0.2, 0.1, 0.1, 12.0),
        ),
        Species(
            "minke",
            (0.012, 0.035, 0.063, 0.091, 0.143, 0.154, 0.166, 0.15, 0.122, 0.086, 0.047, 0.026, 0.022, 0.02),
            *(0.29, 0.085, 0.08, 0.27, 0.13, 0.04, 0.66, 0.045),
            *((66, 70, 68), (150, 155, 155), 0.0, 0.1, 0.0, 7.5),
        ),
        Species(
            "fin",
            (0.01, 0.03, 0.055, 0.078, 0.105, 0.122, 0.126, 0.118, 0.1, 0.074, 0.046, 0.026, 0.022, 0.02),
            *(0.24, 0.075, 0.07, 0.22, 0.1, 0.035, 0.74, 0.04),
            *((72, 72, 70), (140, 145, 145), 0.1, 0.05, 0.0, 18.0),
        ),
        # Mottled grey, a row of knuckles in place of the dorsal fin. The trainer never draws it: a validation
        # species.
        Species(
            "gray",
            (0.025, 0.05, 0.075, 0.105, 0.15, 0.178, 0.185, 0.17, 0.138, 0.1, 0.065, 0.038, 0.034, 0.03),
            *(0.27, 0.09, 0.085, 0.25, 0.14, 0.075, 0.0, 0.0),
            *((96, 98, 98), (170, 176, 178), 0.25, 0.8, 0.1, 12.0),
        ),
    )
}

# For training and validation alone: the simulated missions and their figures stay with those above.
MORE_SPECIES: dict[str, Species] = {
    item.name: item
    for item in (
        # Slender and sickle-finned, with round pale scars. A validation species, too.
        Species(
            "sei",
            (0.012, 0.034, 0.06, 0.086, 0.12, 0.14, 0.146, 0.136, 0.112, 0.08, 0.048, 0.027, 0.022, 0.02),
            *(0.25, 0.08, 0.075, 0.24, 0.09, 0.035, 0.67, 0.06),
            *((70, 66, 60), (132, 130, 126), 0.0, 0.35, 0.0, 15.0),
        ),
        # Very long, pale blue-grey and mottled all over.
        Species(
            "blue",
            (0.015, 0.045, 0.07, 0.092, 0.112, 0.122, 0.124, 0.114, 0.094, 0.068, 0.042, 0.024, 0.02, 0.018),
            *(0.22, 0.07, 0.065, 0.25, 0.115, 0.035, 0.77, 0.015),
            *((128, 118, 104), (160, 156, 146), 0.05, 0.9, 0.0, 23.0),
        ),
        # As broad as the right whale, all black but for a white chin, no fin.
        Species(
            "bowhead",
            (0.03, 0.065, 0.1, 0.15, 0.2, 0.232, 0.238, 0.215, 0.17, 0.118, 0.07, 0.04, 0.034, 0.03),
            *(0.36, 0.115, 0.1, 0.3, 0.13, 0.085, 0.0, 0.0),
            *((34, 34, 36), (178, 184, 186), 0.2, 0.03, 0.05, 15.0),
        ),
        # White, or grey when young; no fin.
        Species(
            "beluga",
            (0.05, 0.085, 0.11, 0.135, 0.175, 0.2, 0.205, 0.19, 0.155, 0.11, 0.068, 0.04, 0.034, 0.03),
            *(0.26, 0.09, 0.07, 0.24, 0.1, 0.07, 0.0, 0.0),
            *((205, 210, 206), (232, 234, 230), 0.0, 0.2, 0.05, 4.2),
        ),
        # Black with white eye patches, a tall fin.
        Species(
            "orca",
            (0.03, 0.07, 0.1, 0.13, 0.175, 0.205, 0.21, 0.185, 0.145, 0.1, 0.06, 0.036, 0.03, 0.026),
            *(0.27, 0.09, 0.075, 0.25, 0.14, 0.1, 0.46, 0.13),
            *((30, 28, 28), (212, 216, 216), 0.18, 0.05, 0.0, 7.0),
        ),
        # Small, black, blunt-headed; always in groups.
        Species(
            "pilot",
            (0.06, 0.09, 0.11, 0.125, 0.15, 0.165, 0.165, 0.15, 0.12, 0.085, 0.052, 0.03, 0.026, 0.022),
            *(0.24, 0.08, 0.07, 0.24, 0.18, 0.05, 0.38, 0.07),
            *((38, 36, 36), (96, 100, 100), 0.0, 0.05, 0.0, 5.5),
        ),
    )
}


def species_named(name: str) -> Species:
    """The species `name`; ValueError lists those that there are."""
    found = SPECIES.get(name) or MORE_SPECIES.get(name)
    if found is None:
        raise ValueError(f"species {name!r} is not known; there are: {', '.join([*SPECIES, *MORE_SPECIES])}")
    return found


def with_widths(species: Species, widths: Array) -> Species:
    """`species` with other full widths, one for each station of STATIONS."""
    if len(widths) != len(STATIONS):
        raise ValueError(f"{len(widths)} widths were given, {len(STATIONS)} are needed: one a station")
    return replace(species, widths=tuple(float(width) for width in widths))


def _centreline(stations: Array, bend: float) -> Array:
    """Sideways offset of the spine: none at the head, growing with the square of the way to the tail."""
    return bend * np.clip(stations - 0.3, 0, None) ** 2


def _to_body(stations: Array, sideways: Array) -> Array:
    """(N, 2) body coordinates (forward, right), the middle of the body at the origin."""
    return np.stack([0.5 - stations, sideways], axis=-1)


def body_outline(species: Species, bend: float = 0.0, count: int = 25) -> Array:
    """(2 count, 2) outline of the trunk in body coordinates (forward, right), in body lengths."""
    stations = np.linspace(0, 1, count) ** 1.2
    half = np.interp(stations, STATIONS, species.widths) / 2
    middle = _centreline(stations, bend)
    left, right = _to_body(stations, middle - half), _to_body(stations, middle + half)
    return np.concatenate([right, left[::-1]])


def fluke_outline(species: Species, bend: float = 0.0, chord_share: float = 1.0) -> Array:
    """(9, 2) outline of the flukes; `chord_share` below 1 shows them pitched up or down by the stroke."""
    root, span = 0.985 - species.fluke_chord * chord_share, species.fluke_span / 2
    sweep = species.fluke_sweep * chord_share
    stations = np.array([root, root + 0.45 * sweep, root + sweep, root + sweep + 0.012, 0.99])
    stations = np.maximum.accumulate(stations)
    sideways = np.array([0.015, 0.55 * span, 0.96 * span, span, 0.45 * span])
    stations = np.concatenate([stations, [0.975], stations[::-1]])
    sideways = np.concatenate([sideways, [0.0], -sideways[::-1]])
    return _to_body(stations, sideways + _centreline(stations, bend))


def fin_outlines(species: Species) -> list[Array]:
    """The two pectoral fins, each (5, 2): swept back from the body's edge."""
    root, length, chord = species.fin_station, species.fin_length, species.fin_chord
    edge = float(np.interp(root, STATIONS, species.widths)) / 2 - 0.01
    stations = np.array([root, root + 0.35 * length, root + 0.75 * length, root + 0.5 * length, root + chord])
    sideways = edge + np.array([0.0, 0.5, 0.8, 0.35, 0.0]) * length
    return [_to_body(stations, side * sideways) for side in (1.0, -1.0)]
