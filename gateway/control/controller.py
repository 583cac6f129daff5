"""Controls one car: handles the commands, decides who may command the car, and keeps the records.

No I/O, no threads, no clock: time is an argument, in seconds of one monotonic clock. For bytes and frames, the loop
calls the `driver` directly (see gateway/control/driver.py).
"""

from collections.abc import Callable, Iterable
from typing import Final, Generic, TypeVar, assert_never

from msgspec.structs import replace

from gateway.control import refusals
from gateway.control.battery import BatteryPolicy
from gateway.control.command_queue import CommandQueue, HeldMotion
from gateway.control.command_records import CommandLog, Pending
from gateway.control.commands import (
    Action,
    Answer,
    Command,
    Drive,
    EmergencyStop,
    EndLoan,
    Fan,
    Find,
    Lend,
    PartAction,
    Pause,
    Resume,
    SetMode,
    Stop,
    TakeLease,
    Unpause,
)
from gateway.control.control_output import Record
from gateway.control.driver import LATE_DRIVE_S, Desk, Driver
from gateway.control.safety_state import LEASE_S, PersistedSafety, Safety
from gateway.control.sender_presence import Senders
from schemas.keys import name_of
from schemas.limits import MAX_QUEUE_TIME_S
from schemas.rights import NO_PEOPLE, Authority, Estop, FleetPause, Loan, People, Right, Sender, binding_pause
from schemas.words import Basis, FrameOrigin, Level, Mode, Motion, Phase, Rank, Reason, Verdict

D_co = TypeVar("D_co", bound=Driver, covariant=True)

START_MARGIN_S: Final = 1.0
"""Margin for a drive that waits for the car. If its frame is not written, the drive expires after the announced wait or
its own duration, whichever is longer, plus this margin, but at most after `MAX_QUEUE_TIME_S`."""


class Controller(Generic[D_co]):
    """The control of one car. Times: s of one monotonic clock.

    It handles the commands and decides who may command the car. Its `driver` knows the car: what it can do, how it is
    stopped, and what may be claimed about it. The two share the queue of commands and the log.
    """

    def __init__(
        self,
        car: str,
        driver: Callable[[Desk], D_co],
        *,
        persisted: PersistedSafety | None = None,
        battery_policy: BatteryPolicy | None = None,
        speed_max: float = 1.0,
        people: People = NO_PEOPLE,
        now: float = 0.0,
        now_ns: int = 0,
    ) -> None:
        """Restore the state from before a restart (`persisted`). `now_ns` is the wall clock at `now`."""
        self.car = car
        self.people = people
        self.safety = Safety.restore(persisted or PersistedSafety(), now, now_ns)
        self._log = CommandLog()
        self._senders = Senders()
        self._queue = CommandQueue(self._log, self._senders, self.safety)
        self.driver = driver(Desk(car, self._log, self._queue, battery_policy or BatteryPolicy(), speed_max))
        self._mover = ""
        """The person whose drive or mode was accepted last, even if its frame is not written yet."""
        self._slept_at = float("-inf")
        """When the last sleep of the computer was noticed."""
        self.was_open = False
        """True if the link was open at least once, so the car may have been driven."""

    # ------------------------------------------------------------------ state

    @property
    def owner(self) -> str:
        """Return the sender of the held motion (the drive in progress), or an empty text if none is held."""
        return self._queue.held.sender.name if self._queue.held else ""

    def expires_in_s(self, now: float) -> float | None:
        """Return the remaining time of the held motion, or None if none is held."""
        return max(0.0, self._queue.held.ends_at - now) if self._queue.held else None

    @property
    def asked(self) -> Mode | None:
        """Return the commanded mode, even if the car is not in it yet. None if unknown."""
        pending = self._queue.mode_change
        if pending is not None and isinstance(pending.command.what, SetMode):
            return pending.command.what.mode
        return self.driver.model.mode.asked

    @property
    def has_records(self) -> bool:
        """Return True if there are records to take."""
        return self._log.has_records

    def take_records(self) -> list[Record]:
        """Return the records since the last call."""
        return self._log.take_records()

    # ------------------------------------------------------------------ link, frames, readings, time

    def link_up(self, now: float) -> None:
        """Begin to bring the car to a known state, because its link is open."""
        self.was_open = True
        self.driver.link_up(now)

    def waits_for(self, now: float) -> str:
        """Describe what a command would have to wait for now. Empty if the car is ready."""
        model = self.driver.model
        if not model.link_open:
            return f"its link: {model.link_reason}"
        if self.is_free(now):
            return ""
        if words := self.driver.wait_words(now):
            return words
        left_s = self._busy_s(now)
        what = "its first stop" if not model.known else "a stop"
        return f"{what}, for {left_s:.1f} s at most"

    def is_free(self, now: float) -> bool:
        """Return True if a command would be sent now, provided that its sender may command the car."""
        return self.driver.model.link_open and self.driver.accepts_commands(now)

    def wait_s(self, what: Action, now: float) -> float:
        """Return how long a drive or a mode waits at most before its frame is written, s, as far as that is known."""
        busy_s = self._busy_s(now)
        match what:
            case SetMode():
                return self.driver.mode_wait_s(busy_s, now)
            case Drive():
                return self.driver.drive_wait_s(busy_s, now)
            case _:
                return busy_s

    def tick(self, now: float) -> None:
        """Check for silence and for the end of a loan. It is called several times a second."""
        if self.safety.loan is not None and self.safety.loan_at(now) is None:
            self._end_loan(f"the loan of {self.car} to {self.safety.loan.to} is over", now)
        self.driver.tick(now)

    def on_sleep(self, slept_s: float, now: float, *, counted: bool) -> None:
        """Stop the car after a sleep of the computer, and end the lease. With `counted`, `now` includes the sleep."""
        self._slept_at = now
        self.safety.lease = None
        if counted:
            self._senders.skip(slept_s)
        else:
            self.safety.loan_until -= slept_s
        self.driver.on_sleep(slept_s, now)

    # ------------------------------------------------------------------ commands

    def command(self, command: Command, now: float) -> Answer:
        """Refuse a command with a reason, or begin to carry it out. Record its transitions."""
        command = replace(command, sender=self.people.ranked(command.sender))
        pending, what = Pending(command, now), command.what
        if self._log.has_accepted(command) and not isinstance(what, Stop | EmergencyStop):
            words = f"a command with id {command.id} was accepted before. Use a new id."
            if not command.streamed:  # the records with this id are of the first command, so only log the second
                self._log.log(Level.WARNING, "duplicate", f"{command.verb} by {command.sender.name}: {words}", now)
                return Answer(Phase.REJECTED, Reason.DUPLICATE, words)
            return self._reject(pending, Reason.DUPLICATE, words, now)
        if not command.streamed:
            self._log.record(pending, Phase.ASKED, now)
        if isinstance(what, Stop | EmergencyStop):
            return self._stop(pending, now)
        # Record the drives of a stream even if they are refused. Otherwise a stream that goes on after a stop would
        # drive the car as soon as somebody else's lease ends.
        is_halted = isinstance(what, Drive) and not self._senders.on_drive(
            command.sender.name, now, streamed=command.streamed, release=what.motion is Motion.STOP
        )
        refusal = refusals.refuse(command, self._context(now, self.driver.refusal(what), is_halted=is_halted))
        if refusal is not None:  # a refused command changes neither the lease nor the hold
            return self._reject(pending, *refusal, now)
        if isinstance(what, Pause):
            return self._stop(pending, now)
        self._log.accept(command)
        if refusals.needs(what).lease:
            self._grant_lease(command, now)
        moves = isinstance(what, SetMode) or (isinstance(what, Drive) and what.motion is not Motion.STOP)
        if moves and command.sender.kind is not Rank.COORDINATOR:  # a drive with motion stop ends no hold
            self._end_hold(command.sender, now)
        if moves:
            self._mover = command.sender.person
        match what:
            case Drive(Motion.STOP):
                return self._release(pending, now)
            case Drive():
                return self._drive(pending, what, now)
            case SetMode(Mode.MANUAL):
                return self._close_mode(pending, now)
            case SetMode(mode):
                return self._set_mode(pending, mode, now)
            case Resume():
                return self._resume(pending, what, now)
            case Unpause(ids):
                return self._unpause(pending, ids, now)
            case Lend():
                return self._lend(pending, what, now)
            case EndLoan():
                return self._take_back(pending, now)
            case TakeLease(release):
                return self._take_lease(pending, now, release=release)
            case Fan(bool() as on) if on == self.driver.model.outputs.fan:
                return self._done(pending, f"the fan is {'on' if on else 'off'} already", now)
            case PartAction() | Find():
                self._queue.add_part_action(pending, self.driver.frames(what), self.driver.part(what), now)
            case _:
                assert_never(what)
        return self._queued(pending, now)

    def record_rejection(self, command: Command, reason: Reason, words: str, now: float) -> Answer:
        """Record a command that its parser has rejected."""
        pending = Pending(command, now)
        if not command.streamed:
            self._log.record(pending, Phase.ASKED, now)
        return self._reject(pending, reason, words, now)

    def on_sender_token(self, name: str, *, alive: bool, now: float) -> None:
        """Update a sender's state: its liveliness token appeared or disappeared."""
        driving = self._queue.held is not None and self._queue.held.sender.name == name
        self._queue.on_sender_token(name, alive=alive, now=now)
        if alive:
            self._senders.on_token(name)
        else:
            self._senders.on_token_lost(name, now, driving=driving)
        if not driving:
            self.safety.mark_holder(name, connected=alive)

    def merge_estops(self, estops: Iterable[Estop], ended: Iterable[str], source: str, now: float) -> None:
        """Merge the fleet-wide e-stops that another gateway reports: those in force, and the ids of ended ones."""
        latched, removed = self.safety.merge(estops, ended)
        for estop in removed:
            words = f"e-stop {estop.id} of {self.car} was ended elsewhere (seen from {source})"
            self._log.log(Level.WARNING, "estop_ended", words, now)
        if not latched:
            return
        why = f": {latched[0].why}" if latched[0].why else ""
        words = (
            f"{self.car} is emergency-stopped with the whole fleet by {name_of(latched[0].by)}{why} "
            f"(e-stop {latched[0].id}, seen from {source})"
        )
        self._log.log(Level.ERROR, "estop_joined", words, now)
        self.halt(words, now)

    def merge_pauses(self, pauses: Iterable[FleetPause], ended: Iterable[str], source: str, now: float) -> None:
        """Merge the pauses that another gateway reports: those in force, and the ids of ended ones."""
        joined, removed = self.safety.merge_pauses(pauses, ended)
        if removed:
            self._log.log(
                Level.INFO, "unpaused", f"the pause of {self.car} was ended elsewhere (seen from {source})", now
            )
        if joined:
            why = f": {joined[0].why}" if joined[0].why else ""
            words = f"{self.car} is paused with the whole fleet by {name_of(joined[0].by)}{why} (seen from {source})"
            self._log.log(Level.WARNING, "paused", words, now)
            self.halt(words, now)

    def halt(self, words: str, now: float) -> None:
        """Drop all commands of the car, and stop it. `words` is the reason."""
        self.driver.halt(words, now)
        self.driver.stop_if_open(now)

    # ------------------------------------------------------------------ each command

    def _stop(self, pending: Pending, now: float) -> Answer:
        """Stop the car, for a stop, an e-stop or a pause."""
        command = pending.command
        sender, note = command.sender, command.note
        if isinstance(command.what, Pause):
            note = self._latch_pause(command, command.what.why, now)
        elif isinstance(command.what, EmergencyStop):
            why, fleet_wide = command.what.why, command.what.fleet_wide
            estop = Estop(command.id, sender.name, why, command.asked_ns, fleet_wide, sender.kind)
            fleet_wide = self.safety.latch(estop).fleet_wide
            until = f"the e-stop lasts until `fleet resume{'' if fleet_wide else f' {self.car}'} --estops`"
            why = f": {estop.why}" if estop.why else ""
            self._log.log(Level.ERROR, "estop", f"{self.car} is emergency-stopped by {sender.name}{why}; {until}", now)
            note = f"{until}; {command.note}" if command.note else until
        elif sender.kind is not Rank.COORDINATOR:
            self.safety.put_on_hold(sender.name, command.asked_ns, sender.kind)
        self.driver.halt(f"{command.verb} by {sender.text_name}", now, by=sender.name)
        if not self.driver.model.link_open or self.driver.shutting_down:
            words = self._describe_unstopped(
                "emergency-stopped" if isinstance(command.what, EmergencyStop) else "stopped"
            )
            words = f"{words} ({command.note})" if command.note else words
            return self._reject(pending, Reason.LINK_DOWN, words, now)
        if not self.driver.model.is_heard:
            silent_s = self.driver.model.silent_s(now)
            silent = f"{self.car} may not get this stop: it has been silent for {silent_s:.0f} s. Look at the car."
            note = f"{silent} ({note})" if note else silent
        worst = self.driver.worst_s(now)
        self._log.record(pending, Phase.QUEUED, now, words=note, worst_case_s=worst)
        self.driver.stop(FrameOrigin.STOP, now, pending)
        return Answer(Phase.QUEUED, words=note, worst_case_s=worst)

    def _describe_unstopped(self, later: str) -> str:
        """Describe what it means for the car that a stop cannot be sent, and what will happen to the car later."""
        car, ending = self.car, self.driver.shutting_down
        if self.driver.model.link_open:
            return f"NOT CONFIRMED: the gateway of {car} is shutting down and stops {car} itself. Look at the car."
        when = "by its next gateway" if ending else "when its link is back"
        return (
            f"NOT STOPPED: {car} is unreachable. If it was driving, it still is: go to the car. It is {later} {when}."
        )

    def _resume(self, pending: Pending, resume: Resume, now: float) -> Answer:
        """End e-stops, the hold, or both, if the sender may end them. The answer says which of them stay."""
        sender, safety, authority = pending.command.sender, self.safety, self.authority_at(now)
        if not resume.ids and self.driver.model.doubted:  # a person says that the car is fine
            self.driver.end_doubt(now)
        named = tuple(each.id for each in safety.estops) if resume.all else resume.ids
        mine = [each for each in safety.estops if authority.may_end_estop(each, sender)]
        if ended := safety.end(each.id for each in mine if each.id in named):
            which = " ".join(estop.id for estop in ended)
            self._log.log(Level.WARNING, "estop_ended", f"e-stop {which} was ended by {sender.name}", now)
        parts = []
        # A copy of this command from another gateway may have ended some before (`EstopSync.forward`).
        if count := len({*named} & {*safety.ended}):
            parts.append("e-stop released" if count == 1 else f"{count} e-stops released")
        elif resume.ids:
            parts.append("no e-stop released")
        hold = safety.hold
        if not resume.ids and authority.denies(sender, Right.RESUME) is None:
            parts.append(f"resumed: the hold by {name_of(hold.by)} has ended" if hold else "resumed: was not on hold")
            self._end_hold(sender, now)
        if safety.estops:
            if not resume.ids and not ended:
                parts.clear()  # do not report the end of the hold: nobody can drive while an e-stop is in force
            parts.append(self._still_estopped(sender, now))
        elif safety.hold is not None:
            ends = self.people.may_end(sender, safety.hold.by, safety.hold.rank)
            fix = f": `fleet resume {self.car}`" if ends else " (a lead)"
            parts.append(f"still on hold by {name_of(safety.hold.by)}{fix}")
        if safety.pauses and not resume.ids:
            parts.append(f"still paused by {name_of(binding_pause(safety.pauses).by)}: `fleet unpause`")
        stays = Reason.ESTOPPED if safety.estops else Reason.HELD if safety.hold else None
        return self._done(pending, "; ".join(parts), now, None if resume.ids else stays)

    # ------------------------------------------------------------------ pauses and loans

    def _latch_pause(self, command: Command, why: str, now: float) -> str:
        pause = FleetPause(command.id, command.sender.name, why, command.asked_ns, command.sender.kind)
        if self.safety.pause(pause):
            words = f"{self.car} is paused with the whole fleet by {name_of(pause.by)}{f': {why}' if why else ''}"
            self._log.log(Level.WARNING, "paused", words, now)
        if pause.id in self.safety.ended_pauses:
            return "this pause has ended already, so the car only stops"
        return "the pause lasts until `fleet unpause`"

    def _unpause(self, pending: Pending, ids: tuple[str, ...], now: float) -> Answer:
        by = pending.command.sender.name
        # Only those in force: whether the sender may end an unknown one can only be said where it is known. If its end
        # came earlier than the pause itself, this gateway learns of the end from the others.
        in_force = [each.id for each in self.safety.pauses]
        if not self.safety.end_pauses(each for each in in_force if not ids or each in ids):
            return self._done(pending, "was not paused", now)
        self._log.log(Level.INFO, "unpaused", f"the pause of {self.car} was ended by {by}", now)
        return self._done(pending, "the pause has ended", now)

    def _lend(self, pending: Pending, lend: Lend, now: float) -> Answer:
        sender = pending.command.sender
        words = f"lent to {lend.to} for {lend.duration_s:g} s"
        if self._mover != lend.to:
            self._clear_for(words, now)
        loan = Loan(lend.to, sender.name, sender.kind, pending.command.asked_ns, lend.duration_s)
        self.safety.lend(loan, now)
        self._log.log(Level.INFO, "lent", f"{self.car} was {words} by {sender.name}", now)
        return self._done(pending, words, now)

    def _take_back(self, pending: Pending, now: float) -> Answer:
        loan = self.safety.loan_at(now)
        if loan is None:
            return self._done(pending, "was not lent", now)
        words = f"the loan to {loan.to} was ended by {pending.command.sender.text_name}"
        self._end_loan(words, now)
        return self._done(pending, f"the loan to {loan.to} has ended", now)

    def _end_loan(self, words: str, now: float) -> None:
        """End the loan. Stop the car if the borrower was the last to move it."""
        loan, self.safety.loan = self.safety.loan, None
        self._log.log(Level.INFO, "loan_ended", f"{self.car}: {words}", now)
        if loan is not None and self._mover == loan.to:
            self._clear_for(words, now)

    def _clear_for(self, words: str, now: float) -> None:
        """End the lease, and stop the car unless it is at rest, because from now on somebody else may drive it."""
        self.safety.lease = None
        if self._queue.has_commands or not self.driver.model.at_rest:
            self.halt(words, now)

    def _still_estopped(self, sender: Sender, now: float) -> str:
        """Describe the e-stops in force, with their ids if there are several, and whether the sender can end them."""
        estops = self.safety.estops
        several = len(estops) > 1
        each = [
            f"by {name_of(estop.by)}"
            + (f' ("{estop.why}")' if estop.why else "")
            + (f" [{estop.id}]" if several else "")
            for estop in estops
        ]
        words, them = f"still emergency-stopped {', '.join(each)}", "them" if several else "it"
        if self.authority_at(now).denies(sender, Right.END_ESTOPS) is not None:
            return f"{words}. {sender.person} cannot release {them}"
        return f"{words}. Release {them} with `fleet resume {self.car} --estops`"

    def _grant_lease(self, command: Command, now: float) -> None:
        """Grant the lease for the duration of the command. Log it if the lease was taken from another sender."""
        sender, before = command.sender, self.safety.lease_at(now)
        match command.what:
            case Drive(duration_s=duration_s):
                lasts_s = self.wait_s(command.what, now) + duration_s
            case SetMode(mode):  # the lease lasts until the mode is open
                opening_s = 0.0 if mode is Mode.MANUAL else self.driver.opening_s(mode)
                lasts_s = self._busy_s(now) + opening_s
            case _:  # other commands do not shorten the lease of a drive
                lasts_s = (self.expires_in_s(now) or 0.0) if self.owner == sender.name else 0.0
        self.safety.grant(sender, now + lasts_s)
        if before is None or before.holder == sender:
            return
        by, of = sender.told_beside(before.holder), before.holder.told_beside(sender)
        words = f"taken over by {by} ({sender.kind}) from {of} ({before.holder.kind})"
        self._log.log(Level.INFO, "lease_taken", words, now)
        if (
            self._queue.held is not None
            and self._queue.held.sender != sender
            and not isinstance(command.what, Drive | SetMode)
        ):
            self.driver.release(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)

    def _take_lease(self, pending: Pending, now: float, *, release: bool) -> Answer:
        sender = pending.command.sender
        name = sender.text_name
        if not release:
            return self._done(pending, f"reserved for {name} for {LEASE_S:g} s, and while it drives", now)
        if not self.safety.release(sender):
            return self._done(pending, f"{name} had no lease of {self.car}", now)
        if self._queue.held is not None and self._queue.held.sender == sender:
            self.driver.release(Phase.COMPLETE, None, f"released by {name}", now)
        return self._done(pending, f"{self.car} is free", now)

    def _busy_s(self, now: float) -> float:
        """Return how many seconds a motion would have to wait for the car, as far as that is known."""
        return max(self.driver.free_at(now) - now, 0.0)

    def _drive(self, pending: Pending, drive: Drive, now: float) -> Answer:
        """Hold a motion. If its sender holds it already, only its end changes."""
        sender, held = pending.command.sender, self._queue.held
        if held is not None and held.motion is drive.motion and held.sender == sender:
            return self._prolong_drive(held, pending, drive.duration_s, now)
        words = f"{drive.motion} by {sender.text_name}"
        self._queue.close_held(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        self._queue.held = HeldMotion(drive.motion, pending, *self._drive_times(pending, drive.duration_s, now))
        if held is not None and held.motion is drive.motion and held.pending.sent:
            self._queue.held.begin(now, self.driver.model.range_cm)
            return self._took_over(pending, "extended", now)
        self.driver.resume_motion(words, now)
        return self._queued(pending, now, self._describe_wait(pending, now))

    def _drive_times(self, pending: Pending, duration_s: float, now: float) -> tuple[float, float]:
        """Return when a drive expires if its frame is not written, and how long it lasts once the frame is written.

        For a sample of a stream, the duration counts from now, and the second value is 0.
        """
        if pending.command.streamed:
            return now + duration_s, 0.0
        wait_s = max(self.wait_s(pending.command.what, now), duration_s) + START_MARGIN_S
        return now + min(wait_s, MAX_QUEUE_TIME_S), duration_s

    def _describe_wait(self, pending: Pending, now: float) -> str:
        """Describe how long a drive or a mode waits for its frame. Empty for a stream, or if it need not wait."""
        command = pending.command
        if command.streamed or (wait_s := self.wait_s(command.what, now)) < LATE_DRIVE_S:
            return ""
        if isinstance(command.what, SetMode):
            after = " after the actions that wait" if self.driver.queue.has_undelayed_part_action else ""
            return f"opens in {wait_s:.1f} s at most{after}: {self.car} is stopped first"
        if words := self.driver.drive_wait_words(now):
            return f"begins after {words}"
        what = "a stop" if self.driver.is_stopping else "a command"
        return f"begins in {wait_s:.1f} s at most: {self.car} is busy with {what}"

    def _prolong_drive(self, held: HeldMotion, pending: Pending, duration_s: float, now: float) -> Answer:
        """Set the end of a held motion anew without another frame, because its sender has sent the same drive again."""
        is_shorter = now + duration_s < held.expires_at
        if held.pending.sent:
            held.expires_at = now + duration_s
        else:
            held.expires_at, held.duration_s = self._drive_times(pending, duration_s, now)
        held.pending.count += 1
        if pending.command.streamed and (held.pending.command.streamed or not held.pending.sent):
            return Answer(Phase.SENT if held.pending.sent else Phase.QUEUED)
        if held.pending.sent:
            return self._pass_drive_on(held, pending, "shortened" if is_shorter else "extended", now)
        self._log.record(
            held.pending,
            Phase.SUPERSEDED,
            now,
            reason=Reason.SUPERSEDED,
            words="the same drive was requested again before this one was sent",
        )
        pending.count = held.pending.count
        held.pending = pending
        return self._queued(pending, now, self._describe_wait(pending, now))

    def _pass_drive_on(self, held: HeldMotion, pending: Pending, changed: str, now: float) -> Answer:
        """Let a command take over the drive of which it has changed the end. Whoever waits for the older one is told.

        `changed` is `extended` or `shortened`.
        """
        sent_s = now - (now if held.began_at is None else held.began_at)
        words = f"sent for {sent_s:.1f} s until now; a newer command has {changed} the drive"
        self._log.record(held.pending, Phase.SENT, now, words=words, basis=Basis.SENT)
        held.pending = pending
        return self._took_over(pending, changed, now)

    def _took_over(self, pending: Pending, changed: str, now: float) -> Answer:
        """Answer a drive that holds the running motion from now on, without a frame of its own."""
        words = f"the running drive was {changed}"
        self._log.record_sent(pending, now, words)
        return Answer(Phase.SENT, words=words)

    def _release(self, pending: Pending, now: float) -> Answer:
        """End whatever moves the car, for a drive with motion stop. Unlike `_stop`, this leaves no hold."""
        sender = pending.command.sender.text_name
        self.driver.end_drive(f"released by {sender}", now)
        self._queue.close_mode_change(Phase.SUPERSEDED, Reason.SUPERSEDED, f"released by {sender}", now)
        if not self.driver.is_stopping and self.driver.model.at_rest:
            return self._done(pending, f"{self.car} is at rest", now)
        worst = self.driver.worst_s(now)
        if not pending.command.streamed:
            self._log.record(pending, Phase.QUEUED, now, worst_case_s=worst)
        self.driver.end_motion(now, None if pending.command.streamed else pending)
        return Answer(Phase.QUEUED, worst_case_s=worst)

    def _close_mode(self, pending: Pending, now: float) -> Answer:
        """Close whatever mode is open, by a full stop. The command is sent with the first frame of the stop."""
        by = pending.command.sender.text_name
        self._queue.drop(Phase.SUPERSEDED, Reason.SUPERSEDED, f"mode manual by {by}", now)
        answer = self._queued(pending, now)
        self.driver.stop(FrameOrigin.COMMAND, now, pending)
        return answer

    def _set_mode(self, pending: Pending, mode: Mode, now: float) -> Answer:
        """Queue the opening of a mode, unless the car is in it. The driver first stops a car that moves."""
        words = f"mode {mode} by {pending.command.sender.text_name}"
        self._queue.close_mode_change(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        self._queue.close_held(Phase.SUPERSEDED, Reason.SUPERSEDED, words, now)
        model = self.driver.model
        settled = model.known and not self.driver.is_stopping and model.mode.verdict is not Verdict.CONTRADICTED
        if settled and self.driver.model.mode.asked is mode:
            return self._done(pending, f"{self.car} is in mode {mode} already ({self.driver.model.mode.verdict})", now)
        wait = self._describe_wait(pending, now)
        self._queue.mode_change = pending
        return self._queued(pending, now, wait)

    # ------------------------------------------------------------------ answers

    def _done(self, pending: Pending, words: str, now: float, reason: Reason | None = None) -> Answer:
        """Answer a command that needed no frame. `reason` says why the car still cannot be used."""
        if not pending.command.streamed:
            self._log.record_sent(pending, now, words, reason)
        return Answer(Phase.SENT, reason, words)

    def _queued(self, pending: Pending, now: float, wait: str = "") -> Answer:
        """Answer a command that waits for the car. `wait` says how long, if it is worth a word."""
        words = wait if self.driver.model.is_heard else "; ".join(filter(None, (wait, self._describe_silence(now))))
        self._log.record(pending, Phase.QUEUED, now, words=words)
        return Answer(Phase.QUEUED, words=words)

    def _describe_silence(self, now: float) -> str:
        silent_s = self.driver.model.silent_s(now)
        return f"{self.car} has been silent for {silent_s:.0f} s: nothing shows that it hears this"

    def _reject(self, pending: Pending, reason: Reason, words: str, now: float) -> Answer:
        self._log.record_rejection(pending, reason, words, now)
        return Answer(Phase.REJECTED, reason, words)

    def _end_hold(self, sender: Sender, now: float) -> None:
        if self.safety.hold is not None:
            words = f"the hold by {self.safety.hold.by} was ended by {sender.name}"
            self._log.log(Level.INFO, "hold_ended", words, now)
            self.safety.hold = None

    def authority_at(self, now: float) -> Authority:
        """Return the facts that decide who may do what with the car at this time."""
        safety = self.safety
        return Authority(
            self.people, safety.estops, safety.pauses, safety.hold, safety.loan_at(now), safety.lease_at(now)
        )

    def _context(
        self, now: float, unsupported: str | None = None, *, is_halted: bool = False
    ) -> refusals.CommandContext:
        held = self._queue.held
        return refusals.CommandContext(
            car=self.car,
            now=now,
            unsupported=unsupported,
            link_open=self.driver.model.link_open,
            link_reason=self.driver.model.link_reason,
            closing=self.driver.shutting_down,
            asked=Mode.MANUAL if self.driver.model.mode.is_over and self._queue.mode_change is None else self.asked,
            authority=self.authority_at(now),
            ended=self.safety.ended,
            battery=self.driver.model.battery.refusal,
            queued=len(self._queue.part_actions),
            loan_until=self.safety.loan_until,
            slept_at=self._slept_at,
            is_halted=is_halted,
            held=None if held is None else (held.motion, held.sender),
            busy_s=self._busy_s(now),
        )
