"""Carries out the stops of one car: repeats each until the car has shown it, or it is clear that the car cannot. Pure.

There is at most one stop at a time (`StopInProgress`). Whoever asks for a stop while one is in progress joins it,
unless the new one is stronger and replaces it. `Executor` writes the frames, and `CarMonitor` reports what the readings
of the car show.

*Tries.* A try is a sequence of frames, which `stop_choice` has chosen, and the wait for a report after them. If nothing
has shown the stop by then, the next try begins. It is a recovery, because by now nobody knows which frames the
car has read. There may be any number of tries.

*The end.* A stop is over if the evidence shows it (see stops/evidence.py), or if the car cannot show it: then its case
says when it ends as sent (see stops/cases.py). It is also over if a newer command takes its place, if the link is lost,
or if the time of a shutdown is over. No other time ends a stop. `fail_late` fails the commands that wait for it, so
that a person learns that nothing has shown it. But the stop goes on, as an overdue one.

*Probes.* A car in mode 0 shows a stop only by two late reports, each after a `MODE00` of its own. So `on_finding` sends
such a `MODE00` as a test frame (a probe), or a control that tells a late report from a lost one.

*Afterwards.* A stop that has ended as sent may not have arrived. So `renewal` repeats it for as long as the car is at
rest, at a slower pace, and without anybody who waits for it.
"""

from typing import Final

from gateway.control.command_records import CommandLog, Pending
from gateway.control.commands import SetMode
from gateway.control.driver import log_unstopped
from gateway.control.trust import STOP_GOES_ON, TrustEvent
from gateway.drivers.yahboom.car_model import CarModel
from gateway.drivers.yahboom.pacing import FLIGHT_S, Gate
from gateway.drivers.yahboom.protocol.frames import ModeClose
from gateway.drivers.yahboom.protocol.timing import RECOVERY_SILENCE_S
from gateway.drivers.yahboom.stop_renewal import StopRenewal
from gateway.drivers.yahboom.stops import cases, sequences, stop_choice, stop_in_progress
from gateway.drivers.yahboom.stops.cases import StopCase, StopFacts
from gateway.drivers.yahboom.stops.evidence import EARLY_S, Finding
from gateway.drivers.yahboom.stops.sequences import StopSequence
from gateway.drivers.yahboom.stops.stop_in_progress import StopInProgress
from schemas.limits import SHUTDOWN_S
from schemas.words import Basis, CarTrust, FrameOrigin, Level, Phase, Reason, Shows

_PROBED: Final = (Finding.REPORT, Finding.BLOCK_GAP, Finding.CONTROL)
"""After one of these findings, the gateway sends a test frame of `sequences` (`PROBE`, or `control` after a control),
if the car may still show the stop."""


class StopExecutor:
    """Carries out one stop at a time. After a stop that has ended without being shown, `renewal` repeats it."""

    def __init__(self, model: CarModel, log: CommandLog) -> None:
        self.model = model
        self.running: StopInProgress | None = None
        self.renewal = StopRenewal(model)
        self.shutting_down = False
        self.not_stopped = ""
        """Why the car was not stopped when the gateway ended. Empty if it was stopped."""
        self._log = log
        self._shutdown_until = float("inf")

    # ------------------------------------------------------------------ begin

    def soft(self, now: float) -> StopSequence:
        """Return the stop that ends a drive."""
        return stop_choice.soft(self.model.for_stop(now))

    def full(self, now: float) -> StopSequence:
        """Return the stop that `stop`, `estop` and a shutdown send."""
        return stop_choice.full(self.model.for_stop(now))

    def begin(self, sequence: StopSequence, why: FrameOrigin, now: float, pending: Pending | None = None) -> None:
        """Begin a stop, or join the running one if that is at least as strong."""
        model = self.model
        model.believed.repeat = False
        joining = [pending] if pending is not None else []
        running = self.running
        if running is None or running.sequence.rank < sequence.rank:
            self._start(sequence, why, now, [*(running.commands if running is not None else ()), *joining])
            return
        running.commands.extend(joining)
        if joining:
            running.repeats = False
        if why is FrameOrigin.SHUTDOWN:
            running.why = why
        # A new command need not wait for the next try, but for this silence: only after it does the car read the next
        # frame by itself, and not as a part of the last one.
        if pending is not None and running.try_sent and now >= running.closed_at + RECOVERY_SILENCE_S:
            running.begin_try(self.full(now), now)
        if running.first_at is not None and pending is not None:
            self._log.record_sent(pending, now, f"joined the running {running.sequence.name} stop")

    def leave_open_mode(self, now: float) -> None:
        """Begin a recovery, because readings show an open mode. In a shutdown or a stop with `MODE00`, do nothing."""
        running = self.running
        got_mode_frame = running is not None and any(
            isinstance(step.frame, ModeClose) for step in running.sequence.steps
        )
        if not got_mode_frame and not self.shutting_down:
            self.recover(
                now, f"{self.model.name} sends readings of a mode other than 0, which general stops do not end"
            )

    def recover(self, now: float, words: str) -> None:
        """Begin to bring the car to a known state. Commands that wait for a running stop then wait for the recovery."""
        before = self.running
        why, commands = (before.why, before.commands) if before is not None else (FrameOrigin.RECOVERY, [])
        self.model.update_trust(TrustEvent.DOUBTED, now, words)
        self.begin_recovery(why, now, commands)

    def begin_recovery(self, why: FrameOrigin, now: float, commands: list[Pending]) -> None:
        """Begin the recovery sequence. It replaces any running stop."""
        self._start(stop_choice.recovery(self.model.for_stop(now)), why, now, commands)

    def _start(self, sequence: StopSequence, why: FrameOrigin, now: float, commands: list[Pending]) -> None:
        model = self.model
        worst_s = stop_choice.worst_s(sequence, model.for_stop(now), model.pacing, now)
        timeout_s = min(worst_s, stop_in_progress.MAX_ANNOUNCED_WORST_S) + stop_in_progress.evidence_s(
            model.profile, model.learned
        )
        self.running = StopInProgress(
            sequence,
            why,
            now,
            now,
            commands,
            worst_at=now + worst_s,
            timeout_s=timeout_s,
            report_wait_s=stop_in_progress.report_wait_s(model.profile, model.learned),
            case=self._case(sequence),
        )
        model.evidence.begin_stop()
        model.update_trust(TrustEvent.STOP_BEGUN, now, f"{sequence.name} stop ({why})")

    def _case(self, sequence: StopSequence) -> StopCase:
        """Return the case that decides when this stop may end although the car has not shown it."""
        return self.model.stop_case(is_soft=sequence.rank == sequences.SOFT.rank)

    def change_case(self) -> None:
        """Choose the case of the running stop again, by the profile that is in force now."""
        if self.running is not None:
            self.running.case = self._case(self.running.sequence)

    # ------------------------------------------------------------------ link, shutdown

    def link_down(self, reason: str, now: float, *, cause: Reason = Reason.LINK_DOWN) -> None:
        """Fail the commands of the running stop, because the link is down."""
        self.renewal.suspend()
        running, self.running = self.running, None
        later = "" if self.shutting_down else " The gateway stops it as soon as the link is back."
        words = (
            f"NOT CONFIRMED: {self.model.name} became unreachable during the stop ({reason}). Look at the car.{later}"
        )
        for pending in running.commands if running else ():
            self._log.record(pending, Phase.FAILED, now, reason=cause, words=words)
        if self.shutting_down and running is not None:
            self._end_unstopped(f"is unreachable ({reason})", now)

    def shut_down(self, now: float) -> None:
        """Stop the car for the last time, unless it has shown that it stands still."""
        self.shutting_down = True
        self._shutdown_until = now + SHUTDOWN_S
        if not self.model.link_open:
            self._end_unstopped(f"is unreachable ({self.model.link_reason})", now)
        elif not (self.model.at_rest and self.model.trust.shown) or self.running is not None:
            self.begin(self.full(now), FrameOrigin.SHUTDOWN, now)

    def is_shutdown_timed_out(self, now: float) -> bool:
        """Return True if a gateway that shuts down has waited long enough for evidence of the stop."""
        return self.shutting_down and now >= self._shutdown_until

    def give_up(self, running: StopInProgress, now: float) -> None:
        """End the stop of the shutdown although the car has not shown it, because the gateway must end."""
        self.running = None
        self._end_unstopped("has not reacted to the stop", now)
        for pending in running.commands:
            self._log.record(pending, Phase.FAILED, now, reason=Reason.NOT_SHOWN, words=self.not_stopped)

    def _end_unstopped(self, why: str, now: float) -> None:
        self.not_stopped = why
        log_unstopped(self._log, self.model.name, why, now)

    # ------------------------------------------------------------------ tries

    def settle(self, running: StopInProgress, now: float) -> None:
        """End the stop as shown, if its last block gap has been followed by the silence that confirms it.

        A block gap is an interval between two reports that exceeds the usual one by exactly the block of `MODE00`.
        """
        if self.model.evidence.settle(now):
            self._finish(running, Basis.SHOWN, self.model.evidence.words, now)

    def check_evidence(self, running: StopInProgress, now: float) -> None:
        """Decide what follows the last frame of a try: the end of the stop, or its next try. Earlier, do nothing.

        The stop ends as sent if the car cannot show it. If the car can, but did not in time, the stop is sent again.
        """
        if not running.try_sent:
            return
        case = self._case_that_ends(running, now)
        if case is cases.SOFT and self.model.is_deaf:
            self._doubt_soft(running, now)
        elif case is not None:
            self._finish(running, Basis.SENT, case.why(self.model.name), now, case)
        elif self.model.evidence.settles_at is None and now >= running.try_due_at(self.model.pacing):
            self._try_again(running, now)

    def _case_that_ends(self, running: StopInProgress, now: float) -> StopCase | None:
        """Return the case with which the stop ends as sent. None if it does not end now."""
        if self.model.trust.state is CarTrust.UNHEARD:
            return None
        facts = self._facts(running, now)
        if not facts.try_sent or not (facts.is_time_up or facts.reported):
            return None
        return running.case.ends(facts)

    def _facts(self, running: StopInProgress, now: float) -> StopFacts:
        model = self.model
        return StopFacts(
            try_sent=running.try_sent,
            sent_once=running.sent_once,
            is_time_up=now >= running.obeys_by,
            reported=running.report_at > running.last_at,
            reported_in_try=running.report_at > running.try_at,
            without_echo=running.no_echo_at > running.closed_at,
            is_soft=running.is_soft,
            probes=running.probes,
            fan_silences=model.believed.fan_may_run and model.profile.fan_silences,
            can_show=model.can_show,
        )

    def _doubt_soft(self, running: StopInProgress, now: float) -> None:
        """Replace a soft stop by a full stop, because the car has not shown its last full stop."""
        what = (
            "although it had not reacted to the last stop"
            if self.model.missed_stop
            else "before it could show its last stop"
        )
        words = f"{self.model.name} was driven again {what}"
        for pending in running.commands:
            self._log.record(pending, Phase.SENT, now, words=words, basis=Basis.SENT)
        self._start(self.full(now), FrameOrigin.RECOVERY, now, [])
        assert self.running is not None
        self.running.overdue = self.running.repeats = True  # such a stop does not hold up the next drive
        self.model.update_trust(TrustEvent.NOT_SHOWN, now, words)

    def _try_again(self, running: StopInProgress, now: float) -> None:
        running.tries += 1
        running.begin_try(stop_choice.recovery(self.model.for_stop(now)), now)
        self.model.evidence.on_retry()

    def fail_late(self, running: StopInProgress, now: float) -> None:
        """Fail the commands that have waited too long for evidence, and continue the stop.

        But if the car has reported since, and it is not known whether its reports can show stops, end the stop as sent.
        """
        if self.model.evidence.settles_at is not None:
            return  # wait for the end of the silence that shows the stop
        car = self.model.name
        is_late = any(now >= pending.received_at + running.timeout_s for pending in running.commands)
        if (is_late or (now >= running.gives_up_at and not running.overdue)) and self._may_be_unable_to_show(running):
            self._finish_unknown(running, now)
            return
        goes_on = f"The gateway keeps stopping it.{self.model.silent_program}"
        words = f"NOT CONFIRMED: {car} has not reacted to the stop yet. Look at the car. {goes_on}"
        waiting: list[Pending] = []
        for pending in running.commands:
            if now < pending.received_at + running.timeout_s:
                waiting.append(pending)
            else:
                self._log.record(pending, Phase.FAILED, now, reason=Reason.NOT_SHOWN, words=words)
        running.commands[:] = waiting
        if now >= running.gives_up_at and not running.overdue:
            running.overdue = True
            if self.model.mode.heard_at > running.began_at:
                self.model.evidence.reacted_at = None
                self.model.missed_stop = True
                self.model.learned.doubted = self.model.learned.shows is Shows.YES
                self.model.update_trust(TrustEvent.NOT_SHOWN, now)
                self._log.log(Level.ERROR, "not_shown", words, now)
            elif self.model.trust.state is not CarTrust.UNHEARD:
                words = f"{car} may still be moving: silent since the stop began. {goes_on}"
                self.model.update_trust(TrustEvent.SILENT, now, words)
                self._log.log(Level.WARNING, "unheard", words, now)

    def _may_be_unable_to_show(self, running: StopInProgress) -> bool:
        """Return True if the car has reported in mode 0 since the stop began, but it may be unable to show stops."""
        is_unknown = self.model.learned.shows is Shows.UNKNOWN
        return is_unknown and running.report_at > running.began_at and self.model.is_heard

    def _finish_unknown(self, running: StopInProgress, now: float) -> None:
        """End the stop as sent, because it is not known whether the reports of this car can show stops."""
        self._finish(running, Basis.SENT, cases.NOT_KNOWN.why(self.model.name), now, cases.NOT_KNOWN)

    def end_doubt(self, now: float) -> None:
        """End the doubt about a car that did not show its last stop, because a person says that it is fine."""
        self.model.learned.forget_reactions()
        if self.running is not None and self.running.overdue and self.model.trust.state is CarTrust.UNPROVEN:
            self._finish_unknown(self.running, now)

    def give_way(self, now: float) -> None:
        """End a stop that the car has not shown yet, because a new command comes instead of its further tries."""
        running, self.running = self.running, None
        words = f"the stop was sent, and {self.model.name} was commanded again before its readings could show it"
        for pending in running.commands if running is not None else ():
            if not isinstance(pending.command.what, SetMode):
                self._log.record(pending, Phase.SUPERSEDED, now, reason=Reason.SUPERSEDED, words=words)

    # ------------------------------------------------------------------ evidence

    def on_finding(self, finding: Finding, at: float, now: float) -> None:
        """Apply the finding of a reading to the running stop."""
        running = self.running
        if running is None or running.first_at is None:
            return
        evidence = self.model.evidence
        if finding is not Finding.NOTHING and at > running.closed_at + FLIGHT_S and at > running.first_at + FLIGHT_S:
            running.report_at = at
            if at >= running.closed_at + evidence.close_s - EARLY_S > float("-inf"):
                running.sent_once = True  # the report shows that the car is in mode 0, and reads frames
        match finding:
            case Finding.SHOWN:
                self._finish(running, Basis.SHOWN, evidence.words, now)
            case Finding.NO_ECHO if at > running.closed_at + evidence.close_s - EARLY_S:
                running.without_echo += 1
                if max(running.without_echo, evidence.without_echo) >= 2:
                    running.no_echo_at = at
            case Finding.LOST:
                self._handle_loss(running, now)
            case _:
                pass
        # Leave the next interval undisturbed, so that the rhythm (the usual interval of the reports) can be learned.
        if finding is Finding.UNJUDGED:
            running.report_wait_s = stop_in_progress.report_wait_s(self.model.profile, self.model.learned, slowest=True)
            if self.model.learned.echo.is_known:  # a rhythm was learned, but now it is another one
                next_s = at - running.last_at + stop_in_progress.SLOWEST_S + stop_in_progress.REPORT_MARGIN_S
                running.report_wait_s = max(running.report_wait_s, next_s)
        if self.running is running:
            self.check_evidence(running, now)
        # A probe proves something only if the car is awake, as it is directly after a report. If the probe cannot be
        # sent now, wait for the next report.
        is_ready = now >= self.model.pacing.ready_at(Gate.ALONE)
        if (
            self.running is running
            and finding in _PROBED
            and is_ready
            and running.case.probes(self._facts(running, now))
        ):
            running.probes += 1
            is_control = finding is Finding.CONTROL
            interval_s = self.model.evidence.interval_s
            running.begin_try(sequences.control(interval_s) if is_control else sequences.PROBE, now)

    def on_contact(self, now: float, words: str) -> None:
        """Stop a car that reports again after a silence.

        The frames that were written during the silence may be lost, or may arrive all at once.
        """
        running = self.running
        if running is None:
            self.recover(now, words)
        else:
            self._try_again(running, now)

    def on_sleep(self, now: float) -> None:
        """Stop the car after a sleep of the computer. If a stop runs that is not soft, send its next try at once."""
        running = self.running
        if running is not None and running.sequence.rank > sequences.SOFT.rank:
            if running.try_sent:
                self._try_again(running, now)
        elif running is not None or not self.shutting_down:
            self.begin(self.full(now), FrameOrigin.STOP, now)

    def _handle_loss(self, running: StopInProgress, now: float) -> None:
        """Send the stop again at once, because the reports have continued without a block gap.

        Do so only in the first try, and only if the case of the stop allows it. The case of a car that contradicts its
        platform does not: it may be a Raspberry Pi, whose reports always continue.
        """
        running.probes += 1
        if (
            running.case.repeats_lost
            and running.tries == 1
            and (running.try_sent or running.sequence is sequences.PROBE)
        ):
            self._try_again(running, now)
            if running.sequence.is_recovery:
                # A report does not prove that the block of the last frame is over: some cars report by a timer, also
                # during a block. A `#` that arrives during the block would be read as one string with the `MODE00`
                # after it.
                running.try_at = max(now, self.model.pacing.flight_until + FLIGHT_S)

    def _finish(
        self, running: StopInProgress, basis: Basis, words: str, now: float, case: StopCase = cases.MANUAL
    ) -> None:
        """End the stop, as shown or as sent."""
        model, shown = self.model, basis is Basis.SHOWN
        self.running = None
        recovered = model.trust.state in STOP_GOES_ON and not model.known
        model.rest_case = case
        model.cut_write = False
        self.renewal.left_mode = model.mode_closed_at >= running.began_at
        model.update_trust(TrustEvent.STOP_SHOWN if shown else TrustEvent.STOP_SENT, now, words)
        if recovered:
            how = "is stopped (confirmed)" if shown else f"got its stop (not confirmed: {words})"
            self._log.log(Level.INFO, "recovered", f"{model.name} {how}, mode manual", now)
        if not shown:
            self.renewal.restart(now)
        phase, reason, evidence = (Phase.COMPLETE, "", (words,)) if shown else (Phase.SENT, words, ())
        for pending in running.commands:
            if not isinstance(pending.command.what, SetMode):
                self._log.record(pending, phase, now, words=reason, evidence=evidence, basis=basis)

    # ------------------------------------------------------------------ times

    def deadlines(self, running: StopInProgress, now: float) -> list[float]:
        """Return when the running stop needs attention."""
        times = self.timeouts(running)
        if self.model.evidence.settles_at is not None:
            times.append(self.model.evidence.settles_at)
        elif running.try_sent:
            times.append(running.try_due_at(self.model.pacing))
        if running.try_sent and running.obeys_by > now:
            times.append(running.obeys_by)
        if not running.try_sent:
            times.append(running.due_at(self.model.pacing))
        return times

    def timeouts(self, running: StopInProgress) -> list[float]:
        """Return when the running stop, or a command that waits for it, fails."""
        times = [pending.received_at + running.timeout_s for pending in running.commands]
        if not running.overdue:
            times.append(running.gives_up_at)
        if (settles_at := self.model.evidence.settles_at) is not None:
            times = [max(each, settles_at) for each in times]
        if self.shutting_down:
            times.append(self._shutdown_until)
        return times

    def worst_s(self, now: float) -> float:
        """Return the longest time until the motors are off, s, if a stop is requested now and its frames arrive."""
        sequence, running = self.full(now), self.running
        if running is not None and running.sequence.rank >= sequence.rank:
            return running.worst_s(now)
        return stop_choice.worst_s(sequence, self.model.for_stop(now), self.model.pacing, now)

    def free_at(self, now: float) -> float:
        """Return when a motion can be sent to the car, as far as that is known."""
        running, ready_at = self.running, self.model.ready_at
        if running is None or running.is_soft:
            return ready_at
        return max(running.over_at(self.model.pacing, now), ready_at)
