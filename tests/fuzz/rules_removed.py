"""The rules of a stop, each with a function that removes it. The search must find the fault that the rule prevents."""

from collections.abc import Callable
from typing import Any

from gateway.drivers.yahboom.driver import YahboomDriver
from gateway.drivers.yahboom.estimate.mode import ModeEstimator
from gateway.drivers.yahboom.protocol import frame_splitter
from gateway.drivers.yahboom.protocol.platforms import Profile
from gateway.drivers.yahboom.stop_executor import StopExecutor
from gateway.drivers.yahboom.stop_renewal import StopRenewal
from gateway.drivers.yahboom.stops import cases, evidence
from gateway.drivers.yahboom.stops.cases import StopCase
from gateway.drivers.yahboom.stops.evidence import StopEvidence
from gateway.drivers.yahboom.stops.stop_in_progress import StopInProgress
from schemas.words import Basis

Patch = Callable[[object, str, Any], None]
"""`pytest.MonkeyPatch.setattr`."""


def _time_decides(patch: Patch) -> None:
    def await_time(self: StopExecutor, running: StopInProgress, now: float) -> None:
        if running.try_sent and now >= running.obeys_by:
            self._finish(running, Basis.SHOWN, "time", now)

    patch(StopExecutor, "check_evidence", await_time)


def _no_second_try(patch: Patch) -> None:
    patch(StopExecutor, "_try_again", lambda self, running, now: setattr(running, "last_at", now))
    patch(StopCase, "probes", lambda self, facts: False)


def _one_gap(patch: Patch) -> None:
    patch(evidence, "BLOCK_GAPS", 1)


def _gaps_of_any_length(patch: Patch) -> None:
    patch(evidence, "BLOCK_GAPS_IN_DOUBT", evidence.BLOCK_GAPS)


def _damaged_frames_count(patch: Patch) -> None:
    patch(evidence, "MIN_SILENCE_S", 0.001)  # not 0: reports of one piece have one time, so no interval
    patch(StopEvidence, "on_noise", lambda self, at, damaged=True: None)


def _frames_continue_after_a_silence(patch: Patch) -> None:
    patch(frame_splitter, "CUT_FRAME_SILENCE_S", float("inf"))


def _any_report_shows_that_a_mode_was_left(patch: Patch) -> None:
    patch(StopEvidence, "_leaving_s", 20.0)


def _any_frame_before_it(patch: Patch) -> None:
    original = StopEvidence._judge_leaving

    def judge_leaving(self: StopEvidence, at: float, silence_s: float, within_s: float) -> evidence.Finding:
        self._closed_alone = self._closed_alone or self._other_mode_at is not None or self._silent_mode is not None
        return original(self, at, silence_s, 20.0)

    patch(StopEvidence, "_judge_leaving", judge_leaving)


def _silent_mode_after_any_rest(patch: Patch) -> None:
    original = StopEvidence.on_mode_opened
    patch(
        StopEvidence,
        "on_mode_opened",
        lambda self, mode, now, *, silent, shown: original(self, mode, now, silent=silent, shown=True),
    )


def _silent_mode_without_its_silence(patch: Patch) -> None:
    patch(Profile, "shortest_opening_s", float("-inf"))


def _no_renewal(patch: Patch) -> None:
    patch(StopRenewal, "schedule", lambda self, now: self.suspend())


def _confirmations_stay(patch: Patch) -> None:
    patch(ModeEstimator, "fade", lambda self, now: None)


def _shutdown_waits_for_time(patch: Patch) -> None:
    def finished(self: YahboomDriver) -> bool:
        running = self.stops.running
        return self.shutting_down and (running is None or running.try_sent)

    patch(YahboomDriver, "finished", property(finished))


def _sent_without_a_report(patch: Patch) -> None:
    def ends(self: StopExecutor, running: StopInProgress, now: float) -> StopCase | None:
        return cases.NO_ECHO if running.try_sent and now >= running.obeys_by else None

    patch(StopExecutor, "_case_that_ends", ends)


def _a_stop_that_is_driven_over_ends_without_a_word(patch: Patch) -> None:
    patch(StopExecutor, "give_way", lambda self, now: setattr(self, "running", None))


def _commands_wait_for_ever(patch: Patch) -> None:
    patch(StopExecutor, "fail_late", lambda self, running, now: None)


RULES: dict[str, Callable[[Patch], None]] = {
    "evidence decides, not time": _time_decides,
    "what is not shown is sent again": _no_second_try,
    "one block gap is not enough": _one_gap,
    "nor are two, if one does not match the normal interval": _gaps_of_any_length,
    "damaged frames are no reports": _damaged_frames_count,
    "a frame with a silence in it is none": _frames_continue_after_a_silence,
    "a report long after MODE00 does not show that a mode was left": _any_report_shows_that_a_mode_was_left,
    "nor one after more frames than MODE00": _any_frame_before_it,
    "a silent mode shows that it was left only if it was opened from a shown rest": _silent_mode_after_any_rest,
    "and after its silence": _silent_mode_without_its_silence,
    "a rest that is only sent is renewed": _no_renewal,
    "a confirmation fades": _confirmations_stay,
    "a shutdown waits for evidence": _shutdown_waits_for_time,
    "only a car that can show nothing ends as sent": _sent_without_a_report,
    "a stop that is driven over has failed": _a_stop_that_is_driven_over_ends_without_a_word,
    "a stop that is not shown fails in time": _commands_wait_for_ever,
}
"""Each rule in words, and the function that removes it."""
