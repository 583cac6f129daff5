"""Example programs, fleet files, plans and worlds. Tests run each program against simulated cars."""

from pathlib import Path
from typing import Final

EXAMPLES: Final = Path(__file__).parent
