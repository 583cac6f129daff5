"""What the hub of a site tells about its links, as the first hub takes it: anybody's words."""

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.bus.credentials import Credentials
from schemas.bus.hub_links import MAX_SITE_LINKS_BYTES, SITE_LINKS_S, HubLinks, parse_site_links

TOLD = {"site": "north", "links": {"car.blue": ["10.0.0.7:4711"], "person.eve": []}}


def test_site_links_round_trip() -> None:
    assert parse_site_links(json.dumps(TOLD).encode()) == ("north", TOLD["links"])


@pytest.mark.parametrize(
    "told",
    [
        {},
        [],
        {**TOLD, "site": "../north"},
        {**TOLD, "site": 7},
        {**TOLD, "links": []},
        {**TOLD, "links": {"car.blue": 7}},
        {**TOLD, "links": {"car.blue": [None]}},
    ],
)
def test_foreign_site_links_are_ignored(told: Any) -> None:
    found = parse_site_links(json.dumps(told).encode())
    assert found is None or found[1] == {}


def test_site_links_with_control_characters_or_too_long_are_ignored() -> None:
    odd = {"site": "north", "links": {"car.\x1b[2J": ["a"], "car.red": ["b" * 101], "car.blue": ["c"]}}
    assert parse_site_links(json.dumps(odd).encode()) == ("north", {"car.blue": ["c"]})
    assert parse_site_links(b" " * MAX_SITE_LINKS_BYTES + json.dumps(TOLD).encode()) is None
    assert parse_site_links(b"[" * 10_000) is None


@given(st.binary(max_size=50))
def test_any_bytes_of_a_site_are_taken(told: bytes) -> None:
    links = HubLinks(Credentials(Path("nowhere"), "tls/127.0.0.1:1"))
    links.take(told, 0.0)


def test_links_of_linked_sites_are_written_until_they_are_old(tmp_path: Path) -> None:
    links, own = HubLinks(Credentials(tmp_path, "tls/127.0.0.1:1")), {"site.north": ["10.0.0.2:7447"]}
    links.take(json.dumps(TOLD).encode(), 0.0)
    links.take(json.dumps({**TOLD, "site": "south"}).encode(), 0.0)  # no hub of such a site is linked

    def written(now: float) -> Any:
        links.write(own, now)
        return json.loads((tmp_path / "links.json").read_text())

    assert written(1.0) == {**own, "car.blue": ["10.0.0.7:4711 (north)"], "person.eve": []}
    assert written(SITE_LINKS_S) == own
