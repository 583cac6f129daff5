"""The search for false claims of a stop, in 400 episodes that never change. `make soak` plays 30,000."""

import pytest

from gateway.sim.model.traits import CarTraits
from schemas.words import Mode
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
    # Three readings lost the `4` of their head within some seconds. Control sent `$WD,MODE00#` from then on.
    EpisodePlan(
        21182, "arduino", "arduino", "echo", "light_seeking", 5.9169053636092634, Ending.STOP,
        (
            LinkFault(Kind.LOSSY, Way.TO_HOST, -0.1, 5.3515134040268055, 0.04),
            LinkFault(Kind.DEAD, Way.TO_CAR, -0.01, 7.543339798198265),
        ),
        traits=CarTraits(interval_s=2.904947964776352, silent_modes=frozenset({Mode.FOLLOWING})),
    ),
    # A `MODE00` that lost its digits blocked, and a held report came late. An unjudged `MODE00` excused the late one.
    EpisodePlan(
        58636, "arduino", "arduino", "echo", "drive", 2.6050211160051737, Ending.STOP,
        (
            LinkFault(Kind.DEAD, Way.TO_CAR, 0.0109375, 0.0010416666666666667),
            LinkFault(Kind.DEAD, Way.TO_CAR, 0.5, 5.643802049812602),
            LinkFault(Kind.STUCK, Way.TO_HOST, -0.27875963026975925, 1.3144714647492637),
        ),
        traits=CarTraits(interval_s=2.471312067781707, spread_s=0.0, close_s=0.0),
    ),
    # Each write muted the link for about one interval, and the car was deaf. Some reports came just after that.
    EpisodePlan(
        61846, "arduino", "arduino", "echo", "drive", 0.7420447949689872, Ending.STOP,
        (
            LinkFault(Kind.DEAD, Way.TO_CAR, -0.1, 19.78799378740391),
            LinkFault(Kind.HALF_DUPLEX, Way.TO_HOST, -0.1, 19.78799378740391, delay_s=1.2413365373202196),
        ),
        traits=CarTraits(spread_s=0.06858682185966497, silent_modes=frozenset({Mode.TRACKING}), text=True),
    ),
    # `MODE00` delayed each report until the car counted as silent. So each report led to the next `MODE00`, for ever.
    EpisodePlan(
        91817, "arduino", "stm32", "no-echo", "drive", 0.8960729485160077, Ending.ESTOP, (),
        traits=CarTraits(interval_s=1.3770950250146663, last_frame_wins=True), kept=True,
    ),
    # The link began to delay reports. One delay was like the block that the car had shown at an earlier stop.
    EpisodePlan(
        253773, "arduino", "arduino", "echo", "drive", 0.31584760952759394, Ending.STOP,
        (
            LinkFault(Kind.SLOW, Way.TO_HOST, -4.0, 30.0, delay_s=1.4985314921454769),
            LinkFault(Kind.DEAD, Way.TO_CAR, -0.01, 2.612158266594101),
        ),
        traits=CarTraits(interval_s=2.125256673661981, close_s=1.3),
    ),
    # A held report, and a `MODE00` that lost a digit and so blocked longer, made two block gaps. Few intervals were
    # known.
    EpisodePlan(
        548956, "arduino", "arduino", "echo", "drive", 3.023257620828898, Ending.STOP,
        (
            LinkFault(Kind.DEAD, Way.TO_CAR, 0.0109375, 0.0010416666666666667),
            LinkFault(Kind.DEAD, Way.TO_CAR, 0.5, 3.2175078137217583),
            LinkFault(Kind.STUCK, Way.TO_HOST, -0.08776365315181955, 1.1425506217950376),
        ),
        traits=CarTraits(interval_s=1.493, spread_s=0.05243534881069913, last_frame_wins=True, text=True),
    ),
    # The stop was lost, and a stream of colors, whistles and servos put off each repeat of it.
    EpisodePlan(
        64, "arduino", "arduino", "echo", "light_seeking", 2.1155810649302937, Ending.STOP,
        (
            LinkFault(Kind.DEAD, Way.TO_HOST, -0.13905653814536215, 1.709375),
            LinkFault(Kind.DEAD, Way.TO_CAR, -0.01, 4.760316107996886),
        ),
        stream_s=1.0469932075369608,
    ),
    # The stop ended as sent by a late report. The blocks of the stream excused the silence that followed, for ever.
    EpisodePlan(
        54, "stm32", "arduino", "echo", "obstacle_avoidance", 0.3010419380200732, Ending.STOP,
        (
            LinkFault(Kind.SLOW, Way.TO_HOST, -3.0, 30.0, delay_s=1.2),
            LinkFault(Kind.SLOW, Way.TO_HOST, -1.5, 28.5, delay_s=2.123971231010005),
            LinkFault(Kind.DEAD, Way.TO_CAR, -0.01, 5.351133351191306),
        ),
        opening=True, early=True, stream_s=0.2,
        traits=CarTraits(interval_s=1.0, spread_s=0.0, timer=True, close_s=0.0, last_frame_wins=True),
    ),
    # The stop was lost. A second one began a new try at once, and each action of a stream put off its first frame.
    EpisodePlan(
        315075, "arduino", "arduino", "wall", "following", 2.5165440634124256, Ending.STOP,
        (LinkFault(Kind.DEAD, Way.TO_CAR, -0.15949700925915766, 2.7122743561884555),),
        again_s=4.527784239525141, driven=True, stream_s=0.11370913327476209,
        traits=CarTraits(interval_s=1.493, spread_s=0.0, close_s=0.0, silent_modes=frozenset({Mode.LIGHT_SEEKING})),
    ),
    # The car stood. It read a renewed stop while the whistle behind it arrived, and took the rest of that for a motion.
    EpisodePlan(
        513721, "arduino", "arduino", "no-echo", "acts", 0.7826454561413663, Ending.MANUAL, (),
        kept=True, stream_s=0.42302983141327405,
        traits=CarTraits(
            interval_s=0.6999929943024791, spread_s=0.001, close_s=0.0, silent_modes=frozenset({Mode.LIGHT_SEEKING})
        ),
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
def test_stop_search_regression_plans(plan: EpisodePlan) -> None:
    assert Episode(plan).play().violations == []
