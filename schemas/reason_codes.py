"""The codes that stand at the end of texts, and the codes of events, each with its meaning. Pure.

docs/how-to/troubleshooting.md has a section for each code. A test compares these tables, the source and the page.
"""

from typing import Final

from msgspec import Struct

from schemas.words import Level, Reason

REASONS: Final[dict[str, str]] = {
    Reason.BAD_VALUE: "The request has a wrong value.",
    Reason.UNSUPPORTED: "This car cannot do this at all.",
    Reason.WRONG_MODE: "The car ignores this command in its mode.",
    Reason.LEASED: "Another sender drives the car.",
    Reason.LENT: "The car is lent to another person.",
    Reason.NOT_ALLOWED: "The people in the fleet file do not allow this to the sender.",
    Reason.PAUSED: "The whole fleet is paused.",
    Reason.HELD: "The car is on hold after a stop.",
    Reason.ESTOPPED: "An emergency stop is in force.",
    Reason.BATTERY_LOW: "The battery is too low for a new drive or mode.",
    Reason.LINK_DOWN: "The gateway cannot reach the car.",
    Reason.WRITE_FAILED: "The link broke while the gateway wrote the command.",
    Reason.QUEUE_FULL: "Too many commands wait for the car.",
    Reason.EXPIRED: "The time of the command was over before the gateway could send it, or its sender disconnected.",
    Reason.LAPSED: "The command only continues a drive, and that drive is over.",
    Reason.SUPERSEDED: "A later command ended this one.",
    Reason.DUPLICATE: "A command with this id was accepted before.",
    Reason.STALE: "The command arrived too late, or its time is in the future.",
    Reason.NOT_SHOWN: "The car could have confirmed the stop, but did not.",
    Reason.STUCK: "A wheel stood still during the drive, so the gateway ended the drive.",
    "no_answer": "No gateway answered for this car.",
    "no_result": "The gateway accepted the command, but its result did not arrive.",
}
"""Reasons of the gateway (`schemas.words.Reason`), and `no_answer` and `no_result` of the client."""


class EventCode(Struct, frozen=True):
    """One code of `event/log`."""

    level: Level
    meaning: str


EVENTS: Final[dict[str, EventCode]] = {
    "link_open": EventCode(Level.INFO, "The link is open, and the gateway brings the car to a known state."),
    "link_lost": EventCode(Level.WARNING, "The link is lost. The text has the cause."),
    "recovered": EventCode(
        Level.INFO, "The recovery stop of the car is over, shown or only sent. The car accepts commands."
    ),
    "platform_settled": EventCode(Level.INFO, "The readings show which program the car runs."),
    "platform_contradicted": EventCode(Level.WARNING, "The readings do not fit the platform in the fleet file."),
    "mode_contradicted": EventCode(Level.WARNING, "The readings do not fit the commanded mode."),
    "not_obeyed": EventCode(Level.WARNING, "A car that has shown its stops before did not react to one."),
    "hears": EventCode(Level.INFO, "The car reacts to stops again."),
    "cannot_show": EventCode(
        Level.INFO, "The car's reports do not react to frames, so nothing shows that a stop arrived."
    ),
    "rhythm_changed": EventCode(Level.WARNING, "The car reports in another rhythm: another program, or another car."),
    "learns_again": EventCode(
        Level.INFO, "The saved knowledge about the car is of another link or platform, so the gateway learns again."
    ),
    "unheard": EventCode(Level.WARNING, "The car is silent for longer than any normal silence. It may be moving."),
    "answers_again": EventCode(Level.INFO, "The car sends readings again, and the gateway stops it first."),
    "not_shown": EventCode(Level.ERROR, "The car could have confirmed a stop, but did not in time. The stop goes on."),
    "not_stopped": EventCode(Level.ERROR, "The gateway ended, but the car has not confirmed its stop."),
    "stalled": EventCode(Level.ERROR, "The gateway stood still during a drive, and stops the car."),
    "slept": EventCode(Level.WARNING, "The computer slept, and the gateway stops the car first."),
    "car_restarted": EventCode(
        Level.WARNING, "The car has restarted. The gateway stops it first, and sets it up again."
    ),
    "moves_unasked": EventCode(Level.WARNING, "The car moves, and nobody here drives it. The gateway stops it."),
    "other_program": EventCode(Level.WARNING, "Another program talks to the car, and can drive it."),
    "wheel_stands": EventCode(Level.WARNING, "A wheel stands still during a drive. The gateway stops the car."),
    "battery_ok": EventCode(Level.INFO, "The battery is above both limits again."),
    "battery_low": EventCode(Level.WARNING, "The battery is below the first limit."),
    "battery_critical": EventCode(Level.ERROR, "The battery is below the second limit."),
    "estop": EventCode(Level.ERROR, "Somebody emergency-stopped the car."),
    "estop_joined": EventCode(Level.ERROR, "The gateway took over an emergency stop of the whole fleet."),
    "estop_ended": EventCode(Level.WARNING, "An emergency stop has ended."),
    "hold_ended": EventCode(Level.INFO, "The hold after a stop has ended."),
    "paused": EventCode(Level.WARNING, "Somebody paused the whole fleet."),
    "unpaused": EventCode(Level.INFO, "The pause of the fleet has ended."),
    "lent": EventCode(Level.INFO, "Somebody lent the car to a person."),
    "loan_ended": EventCode(Level.INFO, "The loan of the car has ended."),
    "lease_taken": EventCode(Level.INFO, "Another sender has taken the car over."),
    "duplicate": EventCode(Level.WARNING, "A command came twice with the same id."),
    "trust": EventCode(Level.DEBUG, "The gateway's knowledge about the motion has changed."),
    "flood": EventCode(Level.WARNING, "More bytes arrive than any car sends."),
    "no_frames": EventCode(Level.WARNING, "Bytes arrive, but never a frame: the baud rate may be wrong."),
    "port_shared": EventCode(Level.WARNING, "Another program reads the car's port, and bytes are missing."),
    "not_saved": EventCode(Level.ERROR, "The gateway could not save holds and e-stops to the disk."),
    "other_link": EventCode(
        Level.WARNING, "A saved hold, loan or e-stop belongs to another link, so it does not apply."
    ),
    "state_unreadable": EventCode(Level.WARNING, "The file of holds and e-stops is damaged, so the car is on hold."),
    "no_hub": EventCode(Level.ERROR, "The gateway cannot reach the bus."),
    "revoked": EventCode(
        Level.ERROR, "The hub passes on no messages of this gateway, whose certificate was revoked. The car is stopped."
    ),
    "certificate_ended": EventCode(
        Level.ERROR, "The certificate of this gateway has ended, so the hub refuses the gateway. The car is stopped."
    ),
    "parent_gone": EventCode(
        Level.WARNING, "The process that started this gateway has ended, so the gateway ends too."
    ),
    "internal_error": EventCode(Level.ERROR, "The coordinator failed in one step of its work, and continues."),
}
"""Codes of `event/log` of cars, and of `@coordinator/log`."""
