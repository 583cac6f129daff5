"""Says how a person gets permission for a serial port."""

import stat
from pathlib import Path
from typing import Final

_ASK: Final = "Ask the administrator for access to the port."
_GROUP_MAY_USE: Final = stat.S_IRGRP | stat.S_IWGRP


def permission_hint(path: str) -> str:
    """Return a sentence with the group that has the port, and the command that lets the user join it."""
    try:
        import grp

        about = Path(path).stat()
        group = grp.getgrgid(about.st_gid).gr_name
    except (ImportError, OSError, ValueError, KeyError):  # no POSIX, or no such port or group
        return _ASK
    if about.st_mode & _GROUP_MAY_USE != _GROUP_MAY_USE or about.st_gid == 0:
        return _ASK  # the group does not help, or is root, in which a user would get much more than the port
    return f"It belongs to group {group}: `sudo usermod -aG {group} $USER`, then log in again"
