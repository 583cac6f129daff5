"""The search for false claims of a stop, in 400 episodes that never change. `make soak` plays 30,000."""

import pytest

from gateway.sim.model.traits import CarTraits
from tests.fuzz.stop_search import BYTES_PER_S, Ending, Episode, EpisodePlan, Kind, LinkFault, Way, explain, search

PARTS = 4
EPISODES = 100

# Control once claimed each of these stops as shown while the motors ran.
FOUND = (
    # The link lost one report and delayed the next, a gap of 1.9 s. The stop had lost bytes, and started the motors.
    EpisodePlan(
        70010567, "arduino", "arduino", "echo", "rest", 0.7768374565829217, Ending.ESTOP,
        (
            LinkFault(Kind.DEAD, Way.BOTH, 0.0033732903838199673, 0.2877418303328459),
            LinkFault(Kind.STUCK, Way.BOTH, -1.4007606644069566, 2.752822054732901),
        ),
    ),
    # The start of one light-seeking report and the end of a later report together looked like a mode-0 report.
    EpisodePlan(
        70010883, "arduino", "arduino", "echo", "light_seeking", 7.667323754918615, Ending.STOP,
        (
            LinkFault(Kind.DEAD, Way.TO_HOST, -1.183403621766109, 3.2037874071570047),
            LinkFault(Kind.DEAD, Way.TO_CAR, -0.5901843230079526, 4.990518586147078),
        ),
        traits=CarTraits(interval_s=0.9209851621644699), driven=True,
    ),
    EpisodePlan(
        81004327, "arduino", "arduino", "echo", "light_seeking", 5.7784868346822424, Ending.STOP,
        (LinkFault(Kind.DEAD, Way.BOTH, -0.3768883565749477, 3.0766070410981188),),
    ),
    # `MODE00` lost both digits, which blocks for only 2.0 s. Control had opened the mode just before a report was due.
    EpisodePlan(
        700013, "arduino", "arduino", "echo", "tracking", 2.8, Ending.STOP,
        (
            LinkFault(Kind.DEAD, Way.TO_CAR, 9.5 / BYTES_PER_S, 2 / BYTES_PER_S),
            LinkFault(Kind.DEAD, Way.TO_CAR, 0.5, 1.5),
        ),
        rest_s=3.15,
    ),
)  # fmt: skip


@pytest.mark.parametrize("part", range(PARTS))
def test_no_stop_is_claimed_and_false(part: int) -> None:
    total = search(range(part * EPISODES, (part + 1) * EPISODES))
    assert not total.failures, explain(total)
    assert total.ends["complete"] > EPISODES // 10
    assert total.ends["sent"] > 0
    assert total.ends["failed"] > 0


@pytest.mark.parametrize("plan", FOUND, ids=lambda plan: str(plan.seed))
def test_what_a_longer_search_found(plan: EpisodePlan) -> None:
    assert Episode(plan).play().violations == []
