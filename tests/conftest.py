"""How many tests run at once."""

import os


def pytest_xdist_auto_num_workers() -> int:
    """Twice the processors: most tests wait, for processes, cars and seconds."""
    return 2 * (os.cpu_count() or 1)
