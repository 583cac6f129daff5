"""Finds out why a car behaves oddly: the likely causes, and the facts behind them. Pure.

`CHECKS` is the table of findings. Each has a code, a function that finds the cause, and a command to type. The
likeliest cause comes first.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

from msgspec import Struct, to_builtins

from fleet.client.car_state import CarState
from fleet.client.claims import describe_end_of_doubt
from fleet.client.gateway_clock import describe_clock
from fleet.client.hints import complete_command, complete_hints
from fleet.client.services import why_unrecorded
from gateway import drivers
from schemas.bluetooth import ADAPTER_FULL
from schemas.keys import COORDINATOR, RECORDER, name_of
from schemas.local_time import clock
from schemas.rights import binding_pause
from schemas.words import (
    UNKNOWN,
    Basis,
    BatteryLevel,
    CarTrust,
    LinkState,
    Mode,
    Motors,
    Phase,
    Reason,
    Shows,
    Verdict,
)

RECENT_COMMAND_S: Final = 600.0
"""Maximum age of a command that `fleet doctor` looks at."""
MAX_ODD_LOOP_LAG_S: Final = 0.25
"""Maximum lag of a gateway's loop on a computer that is not overloaded."""
MAX_REJECTED_SHARE: Final = 0.05
"""Maximum share of rejected frames on a link that works."""
_MIN_REJECTED: Final = 10
MAX_AIRTIME: Final = 0.8
MIN_ODD_RECONNECTS: Final = 2
_NOT_OBEYED: Final = "not_obeyed"
_SILENT: Final = "silent"
_PORT_SHARED: Final = "port_shared"
_FLOOD_BYTES: Final = "flood_bytes"
_BAUD_DOUBTS: Final = ("wrong_baud", "no_frames")
_NO_FRAMES: Final = frozenset({_NOT_OBEYED, _PORT_SHARED, *_BAUD_DOUBTS, _FLOOD_BYTES, "raw_not_published", "text"})
"""The names in a link's `rejects` that do not count rejected frames."""
FAILED_PHASES: Final = (Phase.REJECTED, Phase.FAILED, Phase.EXPIRED)
"""Phases of a command that was not carried out."""
_CARRIED_OUT: Final = (Phase.SENT, Phase.EFFECT_SEEN, Phase.COMPLETE)
_NO_TROUBLE: Final = (Reason.SUPERSEDED, Reason.DUPLICATE)
"""Reasons of commands that ended early because somebody intended it."""


class CarEvidence(Struct, frozen=True):
    """Everything that is known about one car now."""

    state: CarState
    now: float
    """The time, by the clock that the state uses."""
    commands: Sequence[tuple[float, Any]] = ()
    """Age (s) and CommandEvent, the newest last."""
    process: Any = None
    """The gateway's process, as the supervisor reports it (fleet.v1.Supervised)."""
    recording: Any = None
    """The recorder's status (fleet.v1.Recording)."""
    assignment: Any = None
    """The roles of the plan (fleet.v1.Assignment)."""
    coordinated: bool = False
    """True if a coordinator is on the bus."""
    services: Mapping[str, str] = {}
    """The services that `fleet up` runs, such as `@recorder`, each with why it is not ready, or an empty text."""
    clock_off_s: float | None = None
    """How far the clock of the gateway's computer is ahead of ours. Negative if it is behind. None if it is about
    right, or not known."""
    runs_here: bool = False
    """True if a gateway of the car runs on this computer, even if it is not on the bus."""
    asked: bool = False
    """True if the states are answers to a query. So something answers for the car, even if the states are old, as in a
    replay."""

    @property
    def failed(self) -> list[tuple[float, Any]]:
        """The commands that were refused, failed or expired, the newest last."""
        return [
            (age, event)
            for age, event in self.commands
            if event.phase in FAILED_PHASES and event.reason not in _NO_TROUBLE
        ]

    @property
    def rejected(self) -> dict[str, int]:
        """The rejected frames by cause."""
        return {each: count for each, count in self.state.link.rejects.items() if each not in _NO_FRAMES}


class DoctorFinding(Struct, frozen=True):
    """One thing that is odd."""

    code: str
    cause: str
    todo: str
    """The command to type."""
    of_fleet: bool = False
    """True if it is about the whole fleet, so that each car has it."""

    def __str__(self) -> str:
        return f"{self.cause} Type: {self.todo}"


class DoctorCheck(Struct, frozen=True):
    """One row of the table. `cause` returns the cause in words, empty if the check finds nothing."""

    code: str
    cause: Callable[[CarEvidence], str]
    todo: str
    """The command to type. `{car}` stands for the car's name."""
    of_fleet: bool = False


def _unheard(e: CarEvidence) -> str:
    if e.state.present or not e.runs_here:
        return ""
    return (
        "Its gateway runs on this computer, and the bus does not hear it. The hub may be restarting, or it refuses the "
        "gateway's certificate: then the gateway stops the car after some 12 s. Its log says which."
    )


def _ended(e: CarEvidence) -> str:
    if e.state.present or e.process is None or e.runs_here:
        return ""
    why = f" ({e.process.words})" if e.process.words else ""
    return f"Its gateway is {e.process.state}{why}. Nothing stops the car, and whether it moves is not known."


def _absent(e: CarEvidence) -> str:
    if e.state.present or e.process is not None or e.runs_here:
        return ""
    return "No gateway serves the car. Nothing stops it, and whether it moves is not known."


def _hung(e: CarEvidence) -> str:
    said = [topic for topic in e.state.states() if e.asked or not e.state.is_stale(topic, e.now)]
    if said or not e.state.present:
        return ""
    return "Its gateway is on the bus but does not answer. The gateway may hang."


def _wrong_clock(e: CarEvidence) -> str:
    if not (words := describe_clock(e.state.car, e.clock_off_s)):
        return ""
    return f"{words} Commands are refused as stale until both clocks are set. Stops, e-stops and pauses still work."


def _adapter_full(e: CarEvidence) -> str:
    link = e.state.link
    return f"Adapter full: {link.reason}." if link.state == LinkState.LOST and ADAPTER_FULL in link.reason else ""


def _lost(e: CarEvidence) -> str:
    link = e.state.link
    if link.state != LinkState.LOST or _adapter_full(e):
        return ""
    reason = link.reason or "no reason is known"
    end = "" if reason.endswith((".", "?")) else "."  # some reasons are sentences
    return f"The link has been lost for {link.since_s:.0f} s: {reason}{end}"


def _contradicted(e: CarEvidence) -> str:
    contradictions = "; ".join(e.state.health.platform_contradictions)
    return f"Its platform may be named wrongly: {contradictions}." if contradictions else ""


def _doubted(e: CarEvidence) -> str:
    if e.state.health.doubted:
        words = "It has shown its stops before, but did not show the last one. Plans leave it alone."
        return f"{words} {describe_end_of_doubt(e.state.car)}"
    if e.state.safety.trust == CarTrust.UNPROVEN:
        return "Its reports have not shown its last stop yet. Look at the car: it may be moving."
    return ""


def _out_of_range(e: CarEvidence) -> str:
    health = e.state.health
    if not health.out_of_range:
        return ""
    fields = ", ".join(health.out_of_range)
    hints = filter(None, (drivers.hint(health.platform, field) for field in health.out_of_range))
    return " ".join((f"Always out of range for a {health.platform} car, and so never published: {fields}.", *hints))


def _baud(e: CarEvidence) -> str:
    link = e.state.link
    if link.rx_frames > sum(e.rejected.values()):  # at least one reading came
        return ""
    if link.rejects.get("wrong_baud", 0):
        return "Bytes arrive, but never a frame. The bytes look like a wrong baud rate: the log has both rates."
    return "Bytes arrive, but never a frame: a wrong baud rate?" if link.rejects.get("no_frames", 0) else ""


def _unreadable(e: CarEvidence) -> str:
    if not e.state.is_unreadable or _baud(e):
        return ""
    return (
        "Bytes arrive, but have been no reading for a while: echoes of our own frames, another device, another baud "
        "rate, or damage on the way."
    )


def _silent_fan(e: CarEvidence) -> str:
    silent_by_fan = e.state.is_silent and e.state.motion.fan
    return "The car is silent, and its fan runs: some cars send nothing while the fan runs." if silent_by_fan else ""


def _silent_car(e: CarEvidence) -> str:
    if not e.state.is_silent or e.state.motion.fan or _baud(e):
        return ""
    last_rx_s = e.state.last_rx_s
    since = "since its link opened" if last_rx_s is None else f"for {last_rx_s:.0f} s"
    words = f"The link is open, and the car has been silent {since}. Is it on, near enough, and charged?"
    was_heard = e.state.link.rx_frames > 0
    hint = "" if was_heard else drivers.hint(e.state.health.platform, _SILENT)
    return f"{words} {hint}" if hint else words


def _shared(e: CarEvidence) -> str:
    if not e.state.link.rejects.get(_PORT_SHARED, 0):
        return ""
    return "Another program has its port open, or had it open: bytes may be missing. The log names the program."


def _damaged(e: CarEvidence) -> str:
    link, count = e.state.link, sum(e.rejected.values())
    # rx_frames also counts the rejected frames.
    if _baud(e) or count < _MIN_REJECTED or count < MAX_REJECTED_SHARE * link.rx_frames:
        return ""
    worst = max(e.rejected, key=lambda cause: e.rejected[cause])
    return f"{count} of {link.rx_frames} frames were not readings, most of them {worst}. The wire or the radio is bad."


def _poured(e: CarEvidence) -> str:
    count = e.state.link.rejects.get(_FLOOD_BYTES, 0)
    if not count:
        return ""
    words = f"More bytes came than any car sends, and {count} were discarded unread"
    return f"{words}: another device, or a wrong baud rate?"


def _estopped(e: CarEvidence) -> str:
    if not e.state.safety.estops:
        return ""
    estop = e.state.safety.estops[0]
    return f"E-stopped by {name_of(estop.by)}{f': {estop.why}' if estop.why else ''}. It accepts only stops."


def _paused(e: CarEvidence) -> str:
    pause = binding_pause(e.state.safety.pauses)
    return "" if pause is None else f"The fleet is paused by {_who(pause, pause.stamp)}."


def _lent(e: CarEvidence) -> str:
    safety = e.state.safety
    if not safety.HasField("loan") or not any(event.reason == Reason.LENT for _, event in e.failed):
        return ""
    return f"It is lent to {safety.loan.to} by {_who(safety.loan, safety.loan.since)}, so others are refused."


def _other_mode(e: CarEvidence) -> str:
    mode = e.state.mode
    if mode.verdict != Verdict.CONTRADICTED:
        return ""
    return f"It should be in mode {mode.asked} and is probably in {mode.inferred}: {mode.evidence}."


def _weak(e: CarEvidence) -> str:
    battery = e.state.current("sensor/battery")
    if battery is None or battery.level not in (BatteryLevel.LOW, BatteryLevel.CRITICAL):
        return ""
    return f"The battery is {battery.level} ({battery.voltage_v:.2f} V). Motors may not start, and the car may reset."


def _held(e: CarEvidence) -> str:
    safety = e.state.safety
    if not safety.HasField("hold"):
        return ""
    return f"On hold: {name_of(safety.hold.by)} sent it a stop. No plan moves the car until someone resumes it."


def _leased(e: CarEvidence) -> str:
    lease = e.state.safety.lease
    if not e.state.safety.HasField("lease") or not any(event.reason == Reason.LEASED for _, event in e.failed):
        return ""
    return f"{name_of(lease.holder)} ({lease.kind}) drives it, so others are refused."


def _breaks(e: CarEvidence) -> str:
    count = e.state.link.reconnects
    return f"The link broke {count} times: cable, range or battery." if count >= MIN_ODD_RECONNECTS else ""


def _restarted(e: CarEvidence) -> str:
    if e.process is None or not e.process.restarts or not e.state.present:
        return ""
    return f"Its gateway was started again {_times(e.process.restarts)}: {e.process.words or 'see its log'}."


def _lags(e: CarEvidence) -> str:
    lag_s = e.state.health.loop_lag_s
    if lag_s <= MAX_ODD_LOOP_LAG_S:
        return ""
    return f"Its gateway stood still for {lag_s:.2f} s: the computer is overloaded."


def _flooded(e: CarEvidence) -> str:
    share = e.state.link.tx_airtime
    return f"Our frames fill {share:.0%} of the link: a program sends too many commands." if share > MAX_AIRTIME else ""


def _refused(e: CarEvidence) -> str:
    if not e.failed:
        return ""
    age, event = e.failed[-1]
    is_over = event.reason == Reason.WRONG_MODE and e.state.mode.asked == Mode.MANUAL
    # The refusal is also over if the car has carried out such a command since then.
    if is_over or any(each.verb == event.verb and each.phase in _CARRIED_OUT for at, each in e.commands if at < age):
        return ""
    return f"{name_of(event.sender)}'s {event.verb} was not carried out {age:.0f} s ago: {_why(event)}."


def _unrecorded(e: CarEvidence) -> str:
    why = why_unrecorded(e.recording) if e.recording is not None else ""
    return f"Nothing is recorded: {why}." if why else ""


def _drops(e: CarEvidence) -> str:
    count = 0 if e.recording is None else sum(e.recording.drops.values())
    return f"The recorder dropped {count} messages: its disk is full or too slow." if count else ""


def _service_missing(e: CarEvidence) -> str:
    missing = {name: why for name, why in e.services.items() if why and not (name == RECORDER and _unrecorded(e))}
    return " ".join(f"The {name.lstrip('@')} is not ready: {why.rstrip('.')}." for name, why in missing.items())


def _stopped_plan(e: CarEvidence) -> str:
    if not e.coordinated or e.assignment is None or not e.assignment.stopped_by:
        return ""
    return f"{name_of(e.assignment.stopped_by)} stopped the plan: it moves no car."


CHECKS: Final = (
    DoctorCheck("gateway_unheard", _unheard, "fleet logs {car}"),
    DoctorCheck("gateway_ended", _ended, "fleet logs {car}"),
    DoctorCheck("no_gateway", _absent, "fleet up"),
    DoctorCheck("gateway_hung", _hung, "fleet logs {car}"),
    DoctorCheck("clock_off", _wrong_clock, "fleet list {car}"),
    DoctorCheck("adapter_full", _adapter_full, "fleet check"),
    DoctorCheck("link_down", _lost, "fleet scan"),
    DoctorCheck("platform_contradicted", _contradicted, "fleet bind"),
    DoctorCheck("not_shown", _doubted, "fleet stop {car}"),
    DoctorCheck("no_frames", _baud, "fleet logs {car}"),
    DoctorCheck("no_reading", _unreadable, "fleet watch {car}/frame/rx"),
    DoctorCheck("fan_silence", _silent_fan, "fleet fan {car}"),
    DoctorCheck(_SILENT, _silent_car, "fleet watch '{car}/sensor/*'"),
    DoctorCheck(_PORT_SHARED, _shared, "fleet logs {car}"),
    DoctorCheck("out_of_range", _out_of_range, "fleet watch {car}/frame/rx"),
    DoctorCheck("damaged_frames", _damaged, "fleet watch {car}/frame/rx"),
    DoctorCheck("flood", _poured, "fleet logs {car}"),
    DoctorCheck("estopped", _estopped, "fleet resume {car} --estops"),
    DoctorCheck("paused", _paused, "fleet unpause"),
    DoctorCheck("mode_contradicted", _other_mode, "fleet stop {car}"),
    DoctorCheck("battery_low", _weak, "fleet get {car}/sensor/battery"),
    DoctorCheck("leased", _leased, "fleet stop {car}"),
    DoctorCheck("lent", _lent, "fleet lend {car} --end"),
    DoctorCheck("link_breaks", _breaks, "fleet logs {car}"),
    DoctorCheck("gateway_restarted", _restarted, "fleet logs {car}"),
    DoctorCheck("overloaded", _lags, "fleet status --processes"),
    DoctorCheck("flooded", _flooded, "fleet watch {car}/event/command"),
    DoctorCheck("held", _held, "fleet resume {car}"),
    DoctorCheck("plan_stopped", _stopped_plan, "fleet plan restart"),
    DoctorCheck("refused", _refused, "fleet why {car}"),
    DoctorCheck("not_recorded", _unrecorded, "fleet record status", of_fleet=True),
    DoctorCheck("service_missing", _service_missing, "fleet status --processes", of_fleet=True),
    DoctorCheck("recorder_drops", _drops, "fleet record status", of_fleet=True),
)
"""The table of findings, the likeliest cause first."""


def diagnose(evidence: CarEvidence, options: str = "") -> list[DoctorFinding]:
    """Return the findings, the likeliest cause first. `options` are added to the commands that they propose."""
    found = [
        DoctorFinding(
            check.code,
            complete_hints(cause, options),
            complete_command(check.todo.format(car=evidence.state.car), options),
            check.of_fleet,
        )
        for check in CHECKS
        if (cause := check.cause(evidence))
    ]
    last = evidence.failed[-1][1].reason if evidence.failed else ""
    # If another finding has the code of the last refusal, that finding explains it: do not list the refusal, too.
    known = any(each.code == last for each in found)
    return [each for each in found if not (known and each.code == "refused")]


def describe(evidence: CarEvidence) -> Iterator[tuple[str, str]]:
    """Yield the facts known about the car, as names and texts."""
    state, claims = evidence.state, evidence.state.claims(evidence.now)
    link, mode, safety, health = (state.current(f"state/{name}") for name in ("link", "mode", "safety", "health"))
    battery = state.current("sensor/battery")
    if not state.present:
        for name, claim in claims.by_name.items():
            if claim.past is not None:
                yield name, claim.words
    if link is not None:
        rejected = ", ".join(f"{count} {cause}" for cause, count in sorted(link.rejects.items()))
        counts = f"{link.rx_frames} frames in, {link.tx_frames} out, {link.reconnects} reconnects"
        yield (
            "link",
            f"{claims.link.short} for {link.since_s:.0f} s, {counts}{f'; rejected: {rejected}' if rejected else ''}",
        )
    if mode is not None:
        is_other = mode.inferred not in ("", mode.asked, UNKNOWN)
        inferred = f", probably {mode.inferred}" if is_other else ""
        yield "mode", f"{claims.mode.short}{inferred}{f': {mode.evidence}' if mode.evidence else ''}"
    if safety is not None:
        yield "motors", f"{claims.motors.words}; trust {safety.trust}"
        yield "control", _control(state.car, safety)
    if health is not None:
        seen = "; ".join(health.platform_evidence) or "no bytes of the car have shown it"
        volts = f", battery {battery.voltage_v:.2f} V ({battery.level})" if battery is not None else ""
        yield "platform", f"{health.platform}{volts}: {seen}"
        yield "reports", describe_reports(health)
    yield "refused", _describe_refused(evidence)
    yield "services", ", ".join(_services(evidence, health))


def doubtful(evidence: CarEvidence) -> set[str]:
    """Return the names of those facts that may be wrong, because the car has not shown them. Names as in `describe`."""
    state = evidence.state
    if not state.present:
        return set(state.claims(evidence.now).by_name)
    found = set()
    if state.mode.asked and state.mode.verdict != Verdict.CONFIRMED:
        found.add("mode")
    if state.safety.motors == Motors.UNKNOWN or (
        state.safety.motors == Motors.OFF and state.safety.motors_basis != Basis.SHOWN
    ):
        found.add("motors")
    if state.link.state not in ("", LinkState.ONLINE, LinkState.QUIET):
        found.add("link")
    if state.health.platform and (state.health.doubted or state.health.shows_stops != Shows.YES):
        found.add("reports")
    return found


def describe_reports(health: Any) -> str:
    """Describe what is known about a car's reports: their rhythm, and whether they show that a stop arrived."""
    rhythm = ""
    if health.HasField("interval_s"):
        blocks = "".join(
            f", {each.replace('_', ' ')} +{health.blocks_s[each]:.2f} s" for each in sorted(health.blocks_s)
        )
        rhythm = f"every {health.interval_s:.2f} s (spread {health.interval_spread_s:.2f} s{blocks}); "
    words = f"{rhythm}{health.shows_stops_words or 'what they show is not known yet'}"
    hint = drivers.hint(health.platform, _NOT_OBEYED) if health.shows_stops == Shows.NO else ""
    return f"{words}. {hint}" if hint else words


def as_dict(evidence: CarEvidence, options: str = "") -> dict[str, Any]:
    """Return the findings and the facts, for JSON. `options` as in `diagnose`."""
    found = [to_builtins(finding) for finding in diagnose(evidence, options)]
    return {"car": evidence.state.car, "findings": found, "facts": dict(describe(evidence))}


def describe_people(car: str, safety: Any) -> Iterator[tuple[str, str]]:
    """Yield who stopped, paused, borrowed or drives a car, with rank and time, and the command that ends it."""
    for estop in safety.estops:
        yield f"e-stopped by {_who(estop, estop.stamp)}", f"fleet resume {car} --estops"
    for pause in safety.pauses:
        yield f"paused with the whole fleet by {_who(pause, pause.stamp)}", "fleet unpause"
    if safety.HasField("hold"):
        yield f"on hold by {_who(safety.hold, safety.hold.since)}", f"fleet resume {car}"
    if safety.HasField("loan"):
        loan = safety.loan
        left = f"for another {loan.expires_in_s:.0f} s"
        yield f"lent to {loan.to} by {_who(loan, loan.since)}, {left}", f"fleet lend {car} --end"
    if safety.HasField("lease"):
        # Do not propose `--take`: it would move the car, and does not work against a lead. Everybody may send a stop,
        # and the lease then ends in 2 s.
        yield f"driven by {name_of(safety.lease.holder)} ({safety.lease.kind})", f"fleet stop {car}"


def _who(deed: Any, stamp: Any) -> str:
    """Return the person of an e-stop, a pause, a hold or a loan, with rank, time and reason."""
    rank = f" ({deed.rank})" if deed.rank else ""
    since = f" since {clock(stamp.seconds)}" if stamp.seconds else ""
    why = f": {deed.why}" if getattr(deed, "why", "") else ""
    return f"{name_of(deed.by)}{rank}{since}{why}"


def _control(car: str, safety: Any) -> str:
    return "; ".join(words for words, _ in describe_people(car, safety)) or "nobody drives, no hold, no e-stop"


def _describe_refused(evidence: CarEvidence) -> str:
    failed = evidence.failed
    if not failed:
        return "no command was refused lately"
    age, event = failed[-1]
    more = f" ({len(failed) - 1} more before)" if len(failed) > 1 else ""
    return f"{event.verb} of {name_of(event.sender)} {age:.0f} s ago: {_why(event)}{more}"


def _services(evidence: CarEvidence, health: Any) -> Iterator[str]:
    if health is not None:
        yield f"gateway up for {health.uptime_s:.0f} s, lag {health.loop_lag_s * 1e3:.0f} ms"
    restarts = 0 if evidence.process is None else evidence.process.restarts
    if restarts:
        yield f"started again {_times(restarts)}"
    recording = evidence.recording
    absent = "recorder does not answer" if RECORDER in evidence.services else "no recorder"
    yield absent if recording is None else f"recorder {recording.state}"
    if not evidence.coordinated:
        yield "coordinator does not answer" if COORDINATOR in evidence.services else "no plan"
    elif evidence.assignment is None or not evidence.assignment.stopped_by:
        roles = () if evidence.assignment is None else evidence.assignment.roles
        role = next((role.name for role in roles if evidence.state.car in role.cars), "none")
        yield f"plan runs, role {role}"
    else:
        yield "plan stopped"


def _why(event: Any) -> str:
    words = event.words.rstrip(".") or event.phase
    return f"{words} [{event.reason}]" if event.reason else words


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
