"""What the coordinator has heard of the cars, and what it must still ask for."""

from fleet.hearing import NEEDED, Hearing
from schemas import messages, topics
from schemas.bus import Sample


def said(topic: str) -> Sample:
    name = topics.TOPICS[topic].message
    payload = messages.message_class(name)(car="red", seq=1).SerializeToString()
    return Sample(f"fleet/red/{topic}", payload, messages.encoding_of(name), 0, 1)


def test_a_car_is_unheard_until_all_is_known_that_could_forbid_a_command() -> None:
    hearing = Hearing()
    assert hearing.unheard == set()
    hearing.token("red", alive=True)
    for topic in NEEDED:
        assert hearing.unheard == {"red"}
        hearing.take(said(topic), 100.0, None)
    assert hearing.unheard == set()
    hearing.token("red", alive=False)
    assert hearing.unheard == set(), "nobody could be asked"
    hearing.token("red", alive=True)
    assert hearing.unheard == {"red"}, "what was known of it may no longer be so"
