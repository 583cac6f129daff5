"""Hides the packages of the extras from the process that imports this module."""

import importlib.abc
import sys
from collections.abc import Sequence
from types import ModuleType

HIDDEN = frozenset(
    {"rerun", "rerun_cli", "rerun_sdk", "pyarrow", "numpy", "pandas", "PIL", "matplotlib", "bleak"}
    | {"starlette", "uvicorn", "websockets", "prometheus_client", "foxglove", "aiomqtt", "paho"}
)


class Hidden(importlib.abc.MetaPathFinder):
    """Fails the import of each module of an extra."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> None:
        if fullname.partition(".")[0] in HIDDEN:
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)


sys.meta_path.insert(0, Hidden())
