"""The generated parts of README.md and docs: `python -m tests.tools.readme` writes them."""

import csv
import inspect
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from google.protobuf.descriptor import FieldDescriptor

from gateway.bus.requests import DEFAULT_MAX_DRIVE_S
from gateway.control.car_monitor import STALL_S
from gateway.control.estimate.trust import TRANSITIONS, CarTrust, TrustEvent, TrustState
from gateway.control.senders import SENDER_GONE_S, STREAM_PAUSE_S
from gateway.control.stop_executor import SHUTDOWN_S
from gateway.control.stop_renewal import RENEWAL_INTERVALS_S
from gateway.control.stops.evidence import EVIDENCE
from gateway.control.stops.sequences import REPEAT_INTERVAL_S
from schemas import messages, topics
from schemas.commands import COMMANDS
from tests.support import vectors
from tests.tools.vectors import STOPS

ROOT = Path(__file__).parent.parent.parent
README = ROOT / "README.md"
STOP_EVIDENCE = ROOT / "docs/reference/stop-evidence.md"
KEYS = ROOT / "docs/reference/keys.md"
_COMMON = {"sender", "kind", "id", "asked", "take", "ttl_s"}


def topic_table() -> str:
    """The table of topics, from the table that the code runs on."""
    rows = ["| key | message | what | units | stale after |", "|---|---|---|---|---|"]
    for topic in topics.TOPICS.values():
        units = ", ".join(f"{name} {unit}" for name, unit in topic.units.items()) or "-"
        stale = f"{topic.stale_after_s:g} s" if topic.stale_after_s is not None else "-"
        key = topic.name if topic.name.startswith("@") else f"<car>/{topic.name}"
        rows.append(f"| `fleet/{key}` | {topic.message} | {topic.about} | {units} | {stale} |")
    return "\n".join(rows)


def key_table() -> str:
    """Return the table of topics with how each is published, kept and shown."""
    rows = [
        "| key | message | what | units | rate | stale after | class | history | cache | Rerun entity |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for topic in topics.TOPICS.values():
        units = ", ".join(f"{name} {unit}" for name, unit in topic.units.items())
        cells = (
            f"`<fleet>/{topic.name if topic.name.startswith('@') else f'<car>/{topic.name}'}`",
            topic.message,
            topic.about,
            units,
            f"{topic.rate_hz:g}/s" if topic.rate_hz else "",
            f"{topic.stale_after_s:g} s" if topic.stale_after_s is not None else "",
            topic.qos,
            str(topic.history_size or ""),
            str(topic.cache_size),
            f"`{topic.entity}`" if topic.entity else "",
        )
        rows.append(f"| {' | '.join(cell or '-' for cell in cells)} |")
    return "\n".join(rows)


def verb_table() -> str:
    """The table of commands, with the fields of each message."""
    rows = ["| verb | fields | what |", "|---|---|---|"]
    for verb, row in COMMANDS.items():
        fields: Any = messages.message_class(row.message).DESCRIPTOR.fields
        own = [_field(field) for field in fields if field.name not in _COMMON]
        rows.append(f"| `{verb}` | {', '.join(own) or '-'} | {row.about} |")
    return "\n".join(rows)


def _field(field: FieldDescriptor) -> str:
    return f"`{field.name}`" + ("..." if field.is_repeated else "")


def help_text() -> str:
    """What `fleet --help` and `gateway --help` print."""
    shown = []
    for program, module in (("fleet", "fleet.cli"), ("gateway", "gateway.cli")):
        done = subprocess.run(
            [sys.executable, "-m", module, "--help"],
            capture_output=True,
            text=True,
            check=True,
            cwd=ROOT,
            env={"COLUMNS": "110", "PATH": "/usr/bin:/bin", "NO_COLOR": "1"},
        )
        shown.append(f"$ {program} --help\n{done.stdout.strip()}".replace(f"python -m {module}", program))
    return "```\n" + "\n\n".join(shown) + "\n```"


def any_client() -> str:
    """The script that needs none of our code; tests/e2e runs it."""
    return "```python\n" + (ROOT / "tests" / "e2e" / "any_client.py").read_text(encoding="utf-8").strip() + "\n```"


def sdk() -> str:
    """The first example; tests/fleet/test_examples.py runs it."""
    program = ROOT / "fleet" / "examples" / "programs" / "drive_one.py"
    return "```python\n" + program.read_text(encoding="utf-8").strip() + "\n```"


_STATES = {
    "manual, nothing unread": "driving or at rest",
    "manual, a frame may be unread": "the same, just after another command",
    "manual, in a block of ours": "a whistle or a servo is under way",
    "in a mode that reads pins": "tracking, light seeking, following, infrared remote",
    "in color_led": "colour LED mode",
    "in obstacle_avoidance": "obstacle avoidance, in a pen at worst",
    "opening": "a mode is being opened (the longest)",
    "link just restored": "the link has just come back, after half of any frame",
    "raspberry_pi": "a Raspberry Pi car (the longest)",
    "unknown platform": "a car whose platform is not known (the longest)",
}
"""What the states of the distribution of stops are called here; of several rows that begin so it is the longest."""


def stops() -> list[dict[str, str]]:
    """Return the distribution of stops that `make vectors` wrote."""
    with STOPS.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file, delimiter="\t"))


def _rows(name: str) -> list[dict[str, str]]:
    """Return the rows of this name."""
    grouped = name in ("opening", "raspberry_pi", "unknown platform")
    named = [row for row in stops() if row["state"] == name]
    begun = [row for row in stops() if row["state"].startswith(name)]
    return [row for row in begun if not row["state"].endswith(("restored", "under way"))] if grouped else named


def _longest(name: str, column: str) -> float:
    """Return the longest of the rows of this name; 0 if no stop of theirs has such a time."""
    times = [float(row[column]) for row in _rows(name)]
    return max((each for each in times if each != float("inf")), default=0.0)


def _shown_after(name: str) -> str:
    """Return when the car had shown its stop, and how often it showed none."""
    rows = _rows(name)
    stops_shown, asked = sum(int(row["shown"]) for row in rows), sum(int(row["stops"]) for row in rows)
    if not stops_shown:
        return "never"
    middle, worst = _longest(name, "shown_p50_s"), _longest(name, "shown_worst_s")
    return f"{middle:.1f} s, at worst {worst:.1f} s ({100 * stops_shown / asked:.0f} % of stops)"


def stop_table() -> str:
    """How long a stop takes, by what the car is doing."""
    rows = ["| the car is | in the middle | worst seen | longest announced | shown after |", "|---|---|---|---|---|"]
    for name, words in _STATES.items():
        middle, worst, announced = (_longest(name, column) for column in ("p50_s", "worst_s", "announced_s"))
        rows.append(f"| {words} | {middle:.2f} s | {worst:.2f} s | {announced:.2f} s | {_shown_after(name)} |")
    return "\n".join(rows)


def evidence_table() -> str:
    """Return the table of what shows a stop, from the table that the gateway runs on."""
    rows = ["| stop | shown by | otherwise |", "|---|---|---|"]
    rows += [f"| {row.stop} | {row.shown_by or 'nothing'} | {row.otherwise} |" for row in EVIDENCE.values()]
    return "\n".join(rows)


def trust_table() -> str:
    """Return the states of trust, with the words that stand below each in the code."""
    about = dict(re.findall(r'^    [A-Z_]+ = "(\w+)"\n    """(.+?)"""', inspect.getsource(CarTrust), re.MULTILINE))
    rows = ["| trust | motors | what the gateway believes |", "|---|---|---|"]
    rows += [f"| `{state}` | {TrustState(state).motors} | {about[state]} |" for state in CarTrust]
    return "\n".join(rows)


def transition_table() -> str:
    """Return where each event leads from each state. A dot stands for no change."""
    rows = [f"| what happens | {' | '.join(f'`{state}`' for state in CarTrust)} |", "|---" * (len(CarTrust) + 1) + "|"]
    for event in TrustEvent:
        to = [TRANSITIONS[state, event] for state in CarTrust]
        cells = ["·" if new is state else str(new) for state, new in zip(CarTrust, to, strict=True)]
        rows.append(f"| {event} | {' | '.join(cells)} |")
    return "\n".join(rows)


def stop_evidence_page() -> str:
    """Return the page of the reference on what shows a stop."""
    return f"""# What shows that a car stopped

`make readme` generates this page from `gateway/control/stops/evidence.py` and `gateway/control/estimate/trust.py`.

No car acknowledges a frame. The gateway sends a stop, and then looks for evidence in the car's readings. The table says
what counts as evidence, by platform, mode and kind of stop. A stop is `shown` if the car gave the evidence. A stop ends
as `sent` if the car can show nothing. If the car could have shown the stop and did not, the stop goes on.

{evidence_table()}

## States of trust

`state/safety` has the state as `trust`, the reason as `trust_evidence`, and the basis of `off` as `motors_basis`.

{trust_table()}

The table of transitions. The columns are the states before the event, and a dot means that the state stays.

{transition_table()}
"""


def mode_table() -> str:
    """Which pairs of mode asked and true mode are told apart, and how soon."""
    groups: dict[tuple[str, str, str], dict[str, list[str]]] = {}
    for row in vectors.rows("mode_truth"):
        key = (row["verdict"], row["by"], row["within_s"])
        groups.setdefault(key, {}).setdefault(row["asked"], []).append(row["true"])
    everything = {each["true"] for each in vectors.rows("mode_truth")}
    rows = ["| asked | in truth | verdict | by | within |", "|---|---|---|---|---|"]
    for (verdict, by, within), pairs in groups.items():
        alike: dict[tuple[str, ...], list[str]] = {}
        for asked, true in pairs.items():
            every = set(true) == everything - {asked}
            others = ("any other",) if every else tuple("the same" if each == asked else each for each in true)
            alike.setdefault(others, []).append(asked)
        for others, named in alike.items():
            limit = (
                "never" if within == "-" and verdict == "assumed" else "its first" if within == "-" else f"{within} s"
            )
            rows.append(f"| {', '.join(named)} | {', '.join(others)} | {verdict} | {by} | {limit} |".replace("_", " "))
    return "\n".join(rows)


def failure_table() -> str:
    """Each failure: what the car does, how long, what is seen. Its times are the code's, and the table of stops'."""
    middle, worst = (_longest("manual, nothing unread", column) for column in ("p50_s", "worst_s"))
    driving = f"{middle:.2f} s, at worst {worst:.1f} s"
    renewed = f"{RENEWAL_INTERVALS_S[0]:g}, {RENEWAL_INTERVALS_S[1]:g} and then every {RENEWAL_INTERVALS_S[2]:g} s"
    restored = _longest("link just restored", "worst_s")
    rows = ["| what happens | what the car does | for how long | what you see |", "|---|---|---|---|"]
    for what, does, long, see in (
        (
            "You let go, or a drive's time is over",
            "stops; the stop is sent again, alone, later",
            f"{driving} after that; again after {REPEAT_INTERVAL_S:g} s, and until something shows it after {renewed}",
            "`complete` of the drive on `event/command`; `motors` off, `sent`: nothing shows this stop",
        ),
        (
            "Somebody says `stop`",
            "stops, and is on hold; a stick that is leaned on is not heard before it was let go",
            f"see below; the stick {STREAM_PAUSE_S:g} s",
            "`worst_case_s` in the answer, `complete` when the car has shown it (see below)",
        ),
        (
            "The program that drives is killed",
            "drives on until its command's time is over, or its token has been gone",
            (
                f"`duration_s` (0.5 s unless asked, {DEFAULT_MAX_DRIVE_S:g} s at most) or "
                f"{SENDER_GONE_S:g} s, and the stop"
            ),
            "the drive ends as `expired`: its sender is gone",
        ),
        (
            "The gateway's loop stalls while the car drives",
            "drives on; is stopped first when the loop runs again",
            f"noticed from {STALL_S:g} s on",
            "`stalled` on `event/log`",
        ),
        (
            "The gateway is killed",
            "**keeps its last motion**: it has no dead-man timer",
            f"until a gateway is back, and then its stop: {restored:.1f} s at worst, mostly less than 0.1 s",
            "its token is gone, it is missing in `fleet list`; `motors: unknown` until it was stopped",
        ),
        (
            "The link is cut, or the car is out of range",
            "**keeps its last motion**",
            f"until the link is back (tried again within a second), and then its stop: {restored:.1f} s at worst",
            "`state/link` `lost` with the reason, `motors: unknown`, commands refused as `link_down`",
        ),
        (
            "The link hangs, and says nothing",
            "keeps its last motion; the gateway sends the stop again and again",
            "noticed after 3 s of silence that nothing explains; stands 15 s after the link is whole (avoiding: 20)",
            "`stale`, `motors: unknown`, trust `unheard`, `unheard` on `event/log`",
        ),
        (
            "The link loses the stop, and the car is heard",
            "drives on until the next try arrives",
            "each 4 to 7 s, for ever",
            "`failed`, `not_shown` on `event/command` and `event/log`, exit code 1; trust `unproven`",
        ),
        (
            "The gateway is told to end, and its car shows no stop",
            "what the last stop did, if that arrived",
            f"the gateway waits {SHUTDOWN_S:g} s; under `fleet up` another one goes on",
            "`not_stopped` on `event/log`, exit code 1",
        ),
        (
            "A Raspberry Pi car loses its TCP client",
            "**its program dies; it keeps its last motion, and nothing can reach it**",
            "until somebody picks it up",
            "`lost`, connection refused, and words that say so",
        ),
        (
            "The car resets (brownout)",
            "stops: it boots in mode 0",
            "at once",
            "a mode that was open is `contradicted`, see below; in mode 0 nothing shows it",
        ),
        (
            "Somebody uses the car's infrared remote, or its app",
            "what they want",
            "as long as they do",
            "if that changes its mode: `contradicted`, see below",
        ),
        (
            "The hub is killed",
            "a drive lapses, modes go on; a gateway starts the hub again",
            "about a second",
            "one gap in everything; nobody need do anything",
        ),
        (
            "The bus is flooded: questions of the past, tokens, drives, payloads of megabytes",
            "what it is told; a command does not wait for answers",
            "a few milliseconds more (`make bench`, `floods`)",
            "`busy` as an answer; over 64 KiB is refused unread (a stop is obeyed); `bus_drops` in `state/health`",
        ),
        (
            "The coordinator is killed",
            "keeps its mode",
            "until somebody changes it",
            "no more `@coordinator/decision`",
        ),
        (
            "The battery runs low",
            "goes on; below 6.6 V no new drive or mode is taken (`--battery-critical`)",
            "a level must show for 5 s: motors pull the voltage down",
            "`sensor/battery` `level`, `battery_low` on `event/log`, commands refused as `battery_low`",
        ),
        (
            "The wrong platform was told",
            "may ignore what it is sent, or worse",
            "three readings running show it",
            "`platform_contradicted` on `event/log`, and `state/health`",
        ),
        (
            "Nonsense comes instead of readings",
            "what it did before",
            "-",
            "counted by cause in `state/link`; a flood is cut off and counted as `raw_not_published`, `flood_bytes`",
        ),
    ):
        rows.append(f"| {what} | {does} | {long} | {see} |")
    return "\n".join(rows)


PARTS = {
    "topics": topic_table,
    "verbs": verb_table,
    "failures": failure_table,
    "stops": stop_table,
    "evidence": evidence_table,
    "modes": mode_table,
    "help": help_text,
    "any_client": any_client,
    "sdk": sdk,
}


PAGES = {README: PARTS, KEYS: {"topics": key_table}}
"""Pages with generated parts, and the function that makes each part."""


def generated(page: Path) -> str:
    """Return the text of `page` with every generated part made anew."""
    text = page.read_text(encoding="utf-8")
    for name, make in PAGES[page].items():
        begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
        before, found, rest = text.partition(begin)
        _, closed, after = rest.partition(end)
        assert found, f"{page.name} has no {begin}"
        assert closed, f"{page.name} has no {end}"
        text = f"{before}{begin}\n{make()}\n{end}{after}"
    return text


if __name__ == "__main__":
    for each in PAGES:
        each.write_text(generated(each), encoding="utf-8")
    STOP_EVIDENCE.parent.mkdir(parents=True, exist_ok=True)
    STOP_EVIDENCE.write_text(stop_evidence_page(), encoding="utf-8")
