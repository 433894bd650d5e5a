"""Who flies: the bridge only in GUIDED and in modes that it asked for itself."""

from drivers.autopilots.ardupilot import Mode

__all__ = ["Authority"]

ASKING_US = 2_000_000  # a mode that we asked for may show up this much later


class Authority:
    """Watches the flight mode. The pilot's stick, a ground station or a failsafe that changes it takes the
    vehicle from us.

    It comes back in two ways only: somebody else sets GUIDED, or, on the ground, the navigator asks for a
    TAKEOFF anew, after having wanted something else. The bridge never fights for GUIDED in the air.
    """

    def __init__(self) -> None:
        self._mode: int | None = None
        self._asked: int | None = None
        self._leaving: int | None = None  # a mode of ours that we asked to leave
        self._asked_us = 0
        self.may_take_off = True

    @property
    def is_ours(self) -> bool:
        """Whether the vehicle obeys us, at once or after a change of mode that we are free to ask for."""
        return self._mode is not None and self._mode in (Mode.GUIDED, self._asked, self._leaving)

    def ask(self, mode: Mode, utime: int) -> None:
        """We ask the autopilot for a mode."""
        if mode != self._asked:
            self._leaving = self._mode if self.is_ours else None
            self._asked = mode
        self._asked_us = utime

    def observe(self, mode: int, utime: int) -> None:
        """The autopilot's mode, from HEARTBEAT or an acknowledgement."""
        first, had_it = self._mode is None, self.is_ours
        self._mode = mode
        if first and mode == Mode.BRAKE:
            # A respawned bridge finds the BRAKE that its forerunner asked for: pilots stop a vehicle by
            # LOITER.
            self.ask(Mode.BRAKE, utime)
        if mode != self._leaving:
            self._leaving = None
        if mode != self._asked and utime - self._asked_us > ASKING_US:
            self._asked = None
        if had_it and not self.is_ours:
            self.may_take_off = False
        elif mode == Mode.GUIDED:
            self.may_take_off = True

    def may_begin_anew(self) -> None:
        """On the ground the navigator wants something else than a take-off: the next TAKEOFF counts again."""
        self.may_take_off = True
