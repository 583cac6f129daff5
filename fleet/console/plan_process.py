"""The coordinator that the console starts for a page, if none runs. It ends with the console."""

import asyncio
import sys
import tempfile
from asyncio.subprocess import DEVNULL, Process
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Final

from fleet.aio import Fleet
from schemas.limits import SHUTDOWN_S
from schemas.process.children import kill
from schemas.process.parent import parent_option

_START_S: Final = 20.0
"""Timeout for the start of a coordinator. It starts in 1 s, on a busy machine in 10 s."""
_END_S: Final = SHUTDOWN_S + 3.0
"""Timeout for the end of a coordinator, which first brings its cars to rest."""
_COORDINATOR_POLL_S: Final = 0.1


class PlanProcess:
    """A process of `fleet plan run`, one at a time. `file` is the fleet file with the abilities and roles of cars."""

    def __init__(self, fleet: Fleet, file: Path) -> None:
        self._fleet = fleet
        self._file = file
        self._process: Process | None = None
        self._starting = asyncio.Lock()

    async def set_plan(
        self, text: str, ask: Callable[[], Awaitable[tuple[bool, str] | None]], silent: Callable[[], Awaitable[str]]
    ) -> tuple[bool, str]:
        """Put a plan in force, and start a coordinator if there is none. Return the answer, or what went wrong.

        ask: asks the coordinator to put the plan in force. It returns None if none answers. silent: returns a text
        about another program's coordinator that does not answer. It may go on at any moment, so none is started beside.
        """
        async with self._starting:
            if (answer := await ask()) is not None:
                return answer
            is_ours = self._process is not None and self._process.returncode is None
            if not is_ours and (why := await silent()):
                return False, f"{why}."
            await self.close()
            with tempfile.TemporaryDirectory(prefix="fleet-console-", ignore_cleanup_errors=True) as name:
                plan, errors = Path(name) / "plan.yaml", Path(name) / "errors"
                await asyncio.to_thread(plan.write_text, text, "utf-8")
                with await asyncio.to_thread(errors.open, "wb") as written:
                    self._process = await asyncio.create_subprocess_exec(
                        *self._command(plan), stdin=DEVNULL, stdout=DEVNULL, stderr=written
                    )
                for _ in range(round(_START_S / _COORDINATOR_POLL_S)):
                    if (answer := await ask()) is not None:
                        return answer
                    if self._process.returncode is not None:
                        break
                    await asyncio.sleep(_COORDINATOR_POLL_S)
                await self.close()
                lines = (await asyncio.to_thread(errors.read_text, "utf-8", "replace")).splitlines()
        return False, lines[-1].removeprefix("fleet: ") if lines else f"No coordinator started within {_START_S:g} s."

    def _command(self, plan: Path) -> tuple[str, ...]:
        client = self._fleet.sync
        listed = ("--fleet-file", str(self._file)) if self._file.is_file() else ()
        where = ("--connect", client.bus.endpoint, "--fleet", client.name, *parent_option())
        return (sys.executable, "-m", "fleet.cli", "plan", "run", str(plan), *listed, *where)

    async def close(self) -> None:
        """End the coordinator, which brings its cars to rest first."""
        process, self._process = self._process, None
        if process is None or process.returncode is not None:
            return
        process.terminate()
        try:
            await asyncio.wait_for(process.wait(), _END_S)
        except TimeoutError:
            kill(process)
            await process.wait()
