"""`podwatch log`: look into a drone's log, mend, cut and join it, and turn it into other formats."""

from tools.log import copying, export, inspect
from tools.log.inspect import describe
from tools.log.shared import app

__all__ = ["app", "copying", "describe", "export", "inspect"]
