"""Ten thousand names in ten seconds at a real coordinator: it decides about few of them, and forgets all of them."""

import time
from pathlib import Path

import pytest

from fleet.coordinator.observer import FORGET_AFTER_S, MAX_ABSENT_CARS
from fleet.coordinator.publications import REPUBLISH_INTERVAL_S
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses, wait_for

FLOODER = Path(__file__).parents[1] / "support" / "flooder.py"
SECONDS = 10.0
PER_S = 1000.0


@pytest.mark.soak
@pytest.mark.parametrize("kind", ["names", "talkers"])
def test_ten_thousand_names_in_ten_seconds(kind: str, tmp_path: Path) -> None:
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    try:
        plan = tmp_path / "plan.yaml"
        plan.write_text("roles: {scout: {mode: manual}}\n")
        decided: list[tuple[float, str]] = []
        fleet.bus.subscribe(
            "fleet/@coordinator/decision",
            lambda sample: decided.append((time.monotonic(), sample.message().subject)),  # type: ignore[attr-defined]
        )
        coordinator = fleet.start("-m", "fleet.cli", "plan", "run", str(plan))

        def subjects() -> set[str]:
            return {each.subject for each in fleet.get("fleet/@coordinator/decision") if not isinstance(each, str)}

        wait_for(lambda: subjects() == {"role scout"}, "it decides")
        before_mb = coordinator.rss_mb()
        flood = fleet.start(str(FLOODER), kind, str(PER_S), str(SECONDS))
        assert flood.wait() == 0, flood.stderr
        ended = time.monotonic()
        wait_for(lambda: len(subjects()) <= MAX_ABSENT_CARS + 1, "it is done with them")
        names = flood.line()
        print(f"\n{kind}: {names} names, {before_mb:.0f} MB before", end="")
        wait_for(lambda: subjects() == {"role scout"}, "all are forgotten", FORGET_AFTER_S + PATIENCE_S)
        after_mb = coordinator.rss_mb()
        print(f", {len(decided)} decisions, {after_mb:.0f} MB after, forgotten after {time.monotonic() - ended:.0f} s")
        assert after_mb < before_mb + 30.0
        assert len(decided) < names, "only what was met alive is decided on"

        def lately() -> set[str]:
            return {subject for at, subject in decided if at > time.monotonic() - REPUBLISH_INTERVAL_S - 1.0}

        wait_for(lambda: lately() == {"role scout"}, "nothing is decided of names that are gone")
        assert coordinator.end() == 0
        assert "Traceback" not in coordinator.stderr
    finally:
        fleet.close()
