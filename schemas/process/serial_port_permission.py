"""Says how a person gets permission for a serial port."""

from pathlib import Path


def permission_hint(path: str) -> str:
    """Return a sentence with the group that has the port, and the command that lets the user join it."""
    try:
        import grp

        group = grp.getgrgid(Path(path).stat().st_gid).gr_name
    except (ImportError, OSError, ValueError, KeyError):  # no POSIX, or no such port or group
        return "Ask the administrator for access to the port."
    return f"It belongs to group {group}: `sudo usermod -aG {group} $USER`, then log in again"
