"""How many tests run at once, how long an example of Hypothesis may take, and what a Ctrl-C is."""

import os
import signal

from hypothesis import HealthCheck, settings

# By default an example that takes 200 ms fails, and so do examples that take a second to make: a machine that stalls
# for as long says nothing of the product. What never ends is pytest's time-out's.
settings.register_profile(
    "patient",
    parent=settings(),
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("patient")

# In the background of a script SIGINT comes ignored, and is in every process that a test starts and would end by it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_xdist_auto_num_workers() -> int:
    """Twice the processors: most tests wait, for processes, cars and seconds."""
    return 2 * (os.cpu_count() or 1)
