"""A link to an autopilot over a serial port, with the standard library's termios. It never blocks."""

import contextlib
import os
import termios

__all__ = ["MavlinkSerial"]

READ_BYTES = 4096


class MavlinkSerial:
    """A serial port in raw mode, 8N1, without flow control.

    Raises ValueError for a rate that the system does not know, OSError for a device that does not open. A
    device that is unplugged later reads as silence.
    """

    def __init__(self, device: str, baud: int, system_id: int = 0) -> None:
        rate = getattr(termios, f"B{baud}", None)
        if rate is None:
            raise ValueError(
                f"{baud} baud: not a rate of this system; usual ones are 57600, 115200 and 921600"
            )
        self.system_id = system_id
        try:
            self._file = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError as error:
            raise OSError(f"{device}: cannot open the serial port ({error.strerror})") from error
        try:
            settings = termios.tcgetattr(self._file)
        except termios.error as error:
            os.close(self._file)
            raise OSError(f"{device}: not a serial port") from error
        settings[0] = settings[1] = settings[3] = 0  # raw: no translation in, out, or of lines
        settings[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
        settings[4] = settings[5] = rate
        termios.tcsetattr(self._file, termios.TCSANOW, settings)

    def write(self, data: bytes) -> None:
        """Send; what the port cannot take now is dropped, as on a radio."""
        if data:
            with contextlib.suppress(OSError):
                os.write(self._file, data)

    def receive(self) -> bytes:
        """All bytes that wait."""
        data = bytearray()
        while True:
            try:
                piece = os.read(self._file, READ_BYTES)
            except OSError:
                return bytes(data)
            if not piece:
                return bytes(data)
            data += piece

    def fileno(self) -> int:
        return self._file

    def close(self) -> None:
        os.close(self._file)
