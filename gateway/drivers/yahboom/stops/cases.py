"""The cases of a stop: what shows it, when it ends without being shown, and what is sent after it. Pure.

Each stop begins with a case. If the car does not show the stop, this case decides whether the stop may end as `sent`
(its frames were written, and no more is claimed), and with which case it ends: the same, or another one. The case at
the end decides how the stop is repeated. To add a case, add a row here.

docs/reference/stop-evidence.md has `CASES` as a table.
"""

from collections.abc import Callable
from typing import Final

from msgspec import Struct

from gateway.drivers.yahboom.protocol.platforms import Profile, StopStyle
from schemas.words import Platform

DOUBTED_PROBES: Final = 2
"""Maximum probes (each a lone `MODE00` as a test) of a car whose readings contradict its platform. The car may be a
Raspberry Pi, which never reacts."""


class StopFacts(Struct, frozen=True):
    """The facts about the stop in progress on which the rules of the cases depend."""

    try_sent: bool
    """All frames of the current try are written."""
    sent_once: bool
    """A whole try was written, or a report has made that unnecessary (see `StopInProgress`)."""
    is_time_up: bool
    """By now the car has obeyed, if the frames arrived."""
    reported: bool
    """A report of mode 0 has arrived after the last frame."""
    reported_in_try: bool
    """A report of mode 0 has arrived since this try began."""
    without_echo: bool
    """The reports after the newest `MODE00` have no echo."""
    is_soft: bool
    probes: int
    fan_silences: bool
    """The fan may run, and the car sends nothing while it does."""
    can_show: bool
    """The car shows stops, or may show them."""


def _never(_: "StopCase", _facts: StopFacts) -> "StopCase | None":
    return None


def _no(_: StopFacts) -> bool:
    return False


class StopCase(Struct, frozen=True, eq=False):
    """One case of a stop, by what was stopped and what the car can report."""

    name: str
    stop: str
    """The stops of this case, for the docs."""
    shown_by: str
    """The evidence that shows the stop, for the docs. Empty if the car cannot show it."""
    otherwise: str
    """The next steps if the stop is not shown, for the docs."""
    words: str = ""
    """Why the stop ends as `sent`, for the record; `{car}` is the car's name."""
    rule: Callable[["StopCase", StopFacts], "StopCase | None"] = _never
    """The function that `ends` calls. Its first argument is this case."""
    probes: Callable[[StopFacts], bool] = _no
    """Returns True if the car could react to a `MODE00` now, and show it."""
    repeats_lost: bool = True
    """True if the stop is sent again at once when no report is late by just the block of `MODE00` (a block gap)."""
    is_sure: bool = True
    """True if the car counts as standing still after a stop that ended this way."""
    renews_whole: bool = False
    """True if the whole stop is repeated, because the car may still be in the mode."""
    clears: bool = False
    """True if the first repeats of the stop are `MODE00`, which clears half a named frame from the car's buffer."""

    def ends(self, facts: StopFacts) -> "StopCase | None":
        """Return the case with which the stop ends now, without evidence. None if it does not end yet."""
        return self.rule(self, facts)

    def why(self, car: str) -> str:
        """Return why the stop of this car ends as `sent`."""
        return self.words.format(car=car)


def _ends_in_time(case: StopCase, facts: StopFacts) -> StopCase | None:
    """End when the car has obeyed, if the frames arrived. No report could say more."""
    return case if facts.is_time_up else None


def _ends_on_report(case: StopCase, facts: StopFacts) -> StopCase | None:
    """End as `_ends_in_time`, but only after a report in this try, as a sign of life. The end of a drive needs none."""
    had_report = facts.reported_in_try or facts.is_soft
    return case if facts.is_time_up and had_report else _by_fan(facts)


def _ends_on_probes(case: StopCase, facts: StopFacts) -> StopCase | None:
    """End when the car has reported, but not reacted to the probes."""
    if facts.reported and facts.probes >= DOUBTED_PROBES:
        return case
    return _by_fan(facts) or _by_echo(facts)


def _ends_in_mode_0(_: StopCase, facts: StopFacts) -> StopCase | None:
    """End only with another case: when something is found that keeps the car from showing its stop."""
    unable = NO_REACTION if facts.reported_in_try and not facts.can_show else None
    return _by_fan(facts) or _by_echo(facts) or unable


def _by_fan(facts: StopFacts) -> StopCase | None:
    """End if the fan may be what makes the car silent."""
    return FAN if facts.is_time_up and facts.fan_silences else None


def _by_echo(facts: StopFacts) -> StopCase | None:
    """End if the reports have no echo: their times depend on the ranging then, and show nothing."""
    if not facts.without_echo:
        return None
    return NO_ECHO if facts.can_show else NO_REACTION


def _probes_wrong(facts: StopFacts) -> bool:
    return facts.try_sent and facts.probes < DOUBTED_PROBES


def _probes_in_mode_0(facts: StopFacts) -> bool:
    # The first frames of a stop are always written before a probe, unless a report shows that the car is in mode 0.
    return facts.can_show and facts.sent_once


LEFT_SHAPE: Final = StopCase(
    "left_shape",
    "full stop, out of a mode in which the car sent readings",
    "one mode-0 report that the car began after it obeyed `MODE00`, and that comes within the block and one "
    "interval. No other frame was sent since the mode was seen. A report that comes up to 0.2 s later counts as one "
    "block gap. In all other cases as in mode 0",
    "the stop goes on",
)
LEFT_SILENT: Final = StopCase(
    "left_silent",
    "full stop, out of a silent mode",
    "the same report, if the car had shown that it was at rest before the mode was opened, and was silent from then "
    "on. Otherwise as in mode 0",
    "the stop goes on",
)
MANUAL: Final = StopCase(
    "manual",
    "full stop or recovery, in mode 0 with a sonar echo",
    "two block gaps, each after a `MODE00` of its own; three if one of them is in doubt. After the last one, no "
    "reading comes too early, and the gateway has sent no frame since its `MODE00`",
    "the stop goes on, but a command may take its place",
    rule=_ends_in_mode_0,
    probes=_probes_in_mode_0,
)
NO_REACTION: Final = StopCase(
    "no_reaction",
    "full stop or recovery; the reports of this car do not react to frames",
    "",
    "`sent` after a report; a general stop every 6 s",
    "{car}'s reports do not react to frames: nothing shows that a stop arrived",
    rule=_ends_in_mode_0,
)
NO_READINGS: Final = StopCase(
    "no_readings",
    "any stop; the car sends no readings",
    "",
    "`sent`; a general stop every 6 s",
    "{car} sends no readings: nothing shows that a stop arrived",
    rule=_ends_in_time,
)
NO_ECHO: Final = StopCase(
    "no_echo",
    "full stop or recovery, in mode 0 without a sonar echo",
    "",
    "`sent` after a report; then four more `MODE00` within 18 s, and a general stop every 6 s",
    "{car} has no sonar echo, so its readings cannot show a stop now",
    clears=True,
)
FAN: Final = StopCase(
    "fan",
    "full stop or recovery while the fan of an Arduino car runs",
    "",
    "`sent`; then the whole stop every 6 s",
    "{car} sends nothing while its fan runs",
    renews_whole=True,
)
SOFT: Final = StopCase(
    "soft",
    "soft stop: a drive has ended, or its sender has disappeared",
    "",
    "`sent`; a general stop every 6 s",
    "readings do not show the end of a drive; `fleet stop {car}` checks it",
    rule=_ends_in_time,
    is_sure=False,
)
ACTED: Final = StopCase(
    "acted",
    "no stop, but a light, servo, whistle or LED frame to a car that has shown that it is at rest",
    "",
    "`sent`; a general stop every 6 s",
    "{car} got another frame after its confirmed stop; a link that loses bytes can turn it into a motion",
)
RASPBERRY_PI: Final = StopCase(
    "raspberry_pi",
    "any stop of a Raspberry Pi car",
    "",
    "`sent` after a report; a general stop every 6 s",
    "a Raspberry Pi car never confirms a stop",
    rule=_ends_on_report,
)
UNKNOWN_PLATFORM: Final = StopCase(
    "unknown_platform",
    "any stop of a car whose platform is not known",
    "",
    "`sent` after a report; a general stop every 6 s",
    "the platform of {car} is not known, so it got general stops only, which stop it in mode 0",
    rule=_ends_on_report,
)
WRONG_PLATFORM: Final = StopCase(
    "wrong_platform",
    "full stop or recovery; the readings contradict the platform",
    "as in mode 0",
    "`sent` if the car continues to report in mode 0; then as without an echo",
    "the readings of {car} contradict its platform, and nothing in them shows the stop",
    rule=_ends_on_probes,
    probes=_probes_wrong,
    repeats_lost=False,
    clears=True,
)
NOT_KNOWN: Final = StopCase(
    "not_known",
    "full stop or recovery; it is not known yet whether the reports of this car react to frames",
    "as in mode 0",
    "the stop goes on until its time is over; then `sent`, and a general stop every 6 s",
    "it is not known yet whether {car}'s reports show that a stop arrived",
)

CASES: Final = (
    LEFT_SHAPE,
    LEFT_SILENT,
    MANUAL,
    NO_REACTION,
    NO_READINGS,
    NO_ECHO,
    FAN,
    SOFT,
    ACTED,
    RASPBERRY_PI,
    UNKNOWN_PLATFORM,
    WRONG_PLATFORM,
    NOT_KNOWN,
)
"""All cases, in the order of the docs."""


def case_of(style: StopStyle, profile: Profile, *, is_soft: bool, can_show: bool) -> StopCase:
    """Return the case with which a stop of this style begins on a car of this profile."""
    if not profile.has_readings:
        return NO_READINGS
    match style:
        case StopStyle.GENERAL:
            return RASPBERRY_PI if profile.kind is Platform.RASPBERRY_PI else UNKNOWN_PLATFORM
        case _ if is_soft:
            return SOFT
        case StopStyle.BOTH:
            return WRONG_PLATFORM
        case StopStyle.MODE_FRAME | StopStyle.TIMER:
            return MANUAL if can_show else NO_REACTION
