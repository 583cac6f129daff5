"""`stop` at 200 random moments in each mode and load: the distribution of what it took against what was announced."""

import random

import pytest

from gateway.control.records import Stop
from tests.gateway.control.test_stops import CASES
from tests.support.virtual import Pair

MOMENTS = 200


@pytest.mark.soak
def test_the_distribution_of_stops() -> None:
    print(f"\n{'case':52} {'p50':>7} {'p95':>7} {'worst':>7} {'announced':>9} {'ratio':>6}")
    for case in CASES:
        took: list[float] = []
        announced = 0.0
        for seed in range(MOMENTS):
            moments = random.Random(1000 + seed)
            pair = Pair(
                case.platform, seed=seed, world=case.world(), told=case.told, transport=case.transport, start_s=2.0
            )
            pair.ready()
            pair.run(moments.random())
            case.load(pair, moments)
            asked_at = pair.now
            answer = pair.ask(Stop(), verb="stop")
            pair.run(9.0)
            took.append(max(0.0, pair.off_for_good_at() - asked_at))
            announced = max(announced, answer.worst_case_s)
            assert took[-1] <= answer.worst_case_s, f"{case} seed {seed}"
        took.sort()
        worst = took[-1]
        ratio = f"{announced / worst:6.2f}" if worst > 0 else "     -"
        middle, high = took[len(took) // 2], took[len(took) * 95 // 100]
        print(f"{case!s:52} {middle:7.3f} {high:7.3f} {worst:7.3f} {announced:9.3f} {ratio}")
