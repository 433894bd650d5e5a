"""What a picture says of its camera before any animal is looked for: nothing, a part, or the same again."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["Sight"]

FLAT_LEVELS = 4  # darkest and brightest differ by less: a dead or covered camera
ROW_STEP = 4  # every fourth row is enough to tell
ROW_LEVELS = 1  # a row of a real picture differs by more in some colour
MOST_EMPTY_SHARE = 0.25  # of a picture's rows that may be empty


class Sight:
    """Looks at shrunk pictures one after another."""

    def __init__(self) -> None:
        self._last = np.zeros((3, 0, 0), np.uint8)
        self._was_flat = False
        self.n_repeats = 0  # pictures right before the last one that were the same to the last bit
        self.trouble = ""  # what is wrong with the last one, for people

    def look(self, planes: NDArray[np.uint8]) -> bool:
        """One picture, (3, H, W) -> whether it is flat."""
        if np.array_equal(planes, self._last):
            self.n_repeats += 1
            return self._was_flat
        self._last = planes.copy()
        self.n_repeats = 0
        self.trouble = ""
        rows = planes[:, ::ROW_STEP]
        levels = rows.max(axis=2).astype(np.int16) - rows.min(axis=2)  # (3, H / ROW_STEP)
        self._was_flat = self.is_flat(planes)
        if self._was_flat:
            self.trouble = "the picture is empty, all of one grey; is the lens covered, does the camera work?"
            return True
        empty = np.all(levels < ROW_LEVELS, axis=0)
        if empty.mean() > MOST_EMPTY_SHARE:
            self.trouble = (
                f"{100 * empty.mean():.0f} % of the picture's rows are empty, each of one colour; is the "
                "camera's cable or its bandwidth at fault?"
            )
        return False

    @staticmethod
    def is_flat(planes: NDArray[np.uint8]) -> bool:
        """Whether there is nothing in it to see: all black, white or grey."""
        return int(planes.max()) - int(planes.min()) < FLAT_LEVELS
