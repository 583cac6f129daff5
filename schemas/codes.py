"""The codes that texts end with or events are named by, each with its meaning. The docs print these tables. Pure.

docs/how-to/troubleshooting.md has a section for each code. A test compares tables, source and page.
"""

from dataclasses import dataclass
from typing import Final

REASONS: Final[dict[str, str]] = {
    "bad_value": "The request has a wrong value.",
    "unsupported": "This car cannot do it in any state.",
    "wrong_mode": "The car ignores this command in its mode.",
    "leased": "Another sender drives the car.",
    "lent": "The car is lent to another person.",
    "not_allowed": "The people of the fleet file do not allow it to this sender.",
    "paused": "The whole fleet is paused.",
    "held": "The car is on hold after a stop.",
    "estopped": "An emergency stop is in force.",
    "battery_low": "The battery is too low for a new drive or mode.",
    "link_down": "The gateway cannot reach the car.",
    "write_failed": "The link broke while the gateway wrote the command.",
    "queue_full": "Too many commands wait for the car.",
    "expired": "The time of the command was over before the gateway could send it, or its sender disconnected.",
    "lapsed": "A sample of a stream continues a drive that is over.",
    "superseded": "A later command ended this one.",
    "duplicate": "A command with this id was accepted before.",
    "stale": "The command arrived too late, or its time is in the future.",
    "not_shown": "The car could have confirmed the stop and did not.",
    "no_answer": "No gateway answered for this car.",
    "no_result": "The gateway took the command, and its result did not arrive.",
}
"""Reasons of the gateway (`schemas.words.Reason`), and `no_answer` and `no_result` of the client."""


@dataclass(frozen=True, slots=True)
class EventCode:
    """One code of `event/log`."""

    level: str
    meaning: str


EVENTS: Final[dict[str, EventCode]] = {
    "link_open": EventCode("info", "The link is open, and the gateway brings the car to a known state."),
    "link_lost": EventCode("warning", "The link is lost. The text has the cause."),
    "recovered": EventCode("info", "The car is stopped in mode manual, and takes commands."),
    "platform_settled": EventCode("info", "The readings show which program the car runs."),
    "platform_contradicted": EventCode("warning", "The readings do not fit the platform in the fleet file."),
    "mode_contradicted": EventCode("warning", "The readings do not fit the commanded mode."),
    "not_obeyed": EventCode("warning", "A car that has shown its stops before did not get one."),
    "hears": EventCode("info", "The car reacts to stops again."),
    "cannot_show": EventCode("info", "The car's reports do not react to frames, so nothing shows that a stop arrived."),
    "rhythm_changed": EventCode("warning", "The car reports in another rhythm: another program, or another car."),
    "learns_again": EventCode("info", "What was learned of a car is of another link or platform, and does not count."),
    "unheard": EventCode("warning", "The car is silent for longer than any normal silence. It may be moving."),
    "answers_again": EventCode("info", "The car sends readings again, and the gateway stops it first."),
    "not_shown": EventCode("error", "The car could have confirmed a stop and did not in time. The stop goes on."),
    "not_stopped": EventCode("error", "The gateway ended, and the car has not confirmed its stop."),
    "stalled": EventCode("error", "The gateway stood still during a drive, and stops the car."),
    "slept": EventCode("warning", "The computer slept, and the gateway stops the car first."),
    "battery_ok": EventCode("info", "The battery is above both limits again."),
    "battery_low": EventCode("warning", "The battery is below the first limit."),
    "battery_critical": EventCode("error", "The battery is below the second limit."),
    "estop": EventCode("error", "Somebody emergency-stopped the car."),
    "estop_joined": EventCode("error", "The gateway took over an emergency stop of the whole fleet."),
    "estop_ended": EventCode("warning", "An emergency stop has ended."),
    "hold_ended": EventCode("info", "The hold after a stop has ended."),
    "paused": EventCode("warning", "Somebody paused the whole fleet."),
    "unpaused": EventCode("info", "The pause of the fleet has ended."),
    "lent": EventCode("info", "Somebody lent the car to a person."),
    "loan_ended": EventCode("info", "The loan of the car has ended."),
    "lease_taken": EventCode("info", "Another sender has taken the car over."),
    "duplicate": EventCode("warning", "A command came twice with the same id."),
    "trust": EventCode("debug", "The gateway's knowledge about the motion has changed."),
    "flood": EventCode("warning", "More bytes arrive than any car sends."),
    "no_frames": EventCode("warning", "Bytes arrive, and never a frame: the baud rate may be wrong."),
    "port_shared": EventCode("warning", "Another program reads the car's port, and bytes are missing."),
    "not_saved": EventCode("error", "The gateway could not save holds and e-stops to the disk."),
    "other_link": EventCode("warning", "A hold, loan or e-stop of another link is not taken over."),
    "state_unreadable": EventCode("warning", "The file of holds and e-stops is damaged, so the car is on hold."),
    "no_hub": EventCode("error", "The gateway cannot reach the bus."),
    "parent_gone": EventCode("warning", "The process that started this gateway has ended, so the gateway ends too."),
    "internal_error": EventCode("error", "The coordinator failed in one decision, and continues."),
}
"""Codes of `event/log` of cars, and of `@coordinator/log`."""
