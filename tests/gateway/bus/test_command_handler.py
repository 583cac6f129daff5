"""The handler of commands saves the safety state again if the disk was full."""

from typing import Any

import pytest

from gateway import drivers
from gateway.bus.command_handler import SAVE_RETRY_S, CommandHandler
from gateway.control.commands import Command, EmergencyStop
from gateway.control.controller import Controller
from gateway.control.driver import Driver
from gateway.control.safety_state import PersistedSafety
from schemas.rights import Sender


class CollectedLog:
    """The log of a gateway, without a bus. Everything else of a publisher is not needed here."""

    def __init__(self) -> None:
        self.codes: list[str] = []

    def publish_log(self, record: Any) -> None:
        self.codes.append(record.code)

    def publish_command(self, *_: object) -> None:
        pass


@pytest.mark.parametrize("failures", [1, 3])
def test_estop_that_could_not_be_saved_is_saved_when_the_disk_has_room(failures: int) -> None:
    now, saved, tries, log = 0.0, list[PersistedSafety](), 0, CollectedLog()

    def save(safety: PersistedSafety) -> None:
        nonlocal tries
        tries += 1
        if tries <= failures:
            raise OSError(28, "No space left on device")
        saved.append(safety)

    control: Controller[Driver] = Controller("red", drivers.driver_of("arduino", {}))
    other: Any = log
    handler = CommandHandler(
        "fleet", "red", control, other, other, save=save, longest_drive_s=10.0, clock=lambda: now, wake=lambda: None,
        on_gap=lambda _: None,
    )  # fmt: skip
    control.command(Command("e1", "estop", Sender("mia"), EmergencyStop("x")), now)
    while now < (failures + 2) * SAVE_RETRY_S:
        handler.flush()
        now += SAVE_RETRY_S / 10
    assert [[each.id for each in safety.estops] for safety in saved] == [["e1"]]
    assert tries == failures + 1, "not in each turn"
    assert log.codes.count("not_saved") == 1
