"""Links to an autopilot: bytes in, bytes out.

Each has write(data), receive() -> bytes, fileno(), close() and system_id.
"""
