"""Tests that turn payloads into commands: the table of verbs, the words of each refusal, and random bytes."""

import json
import math
import time
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import fields

from gateway.bus import command_parser
from gateway.bus.car_service import Request
from gateway.bus.command_parser import BadRequest, parse
from gateway.control.commands import (
    PLAIN_ACTIONS,
    Action,
    AimServo,
    ChangeSpeed,
    Command,
    Drive,
    EmergencyStop,
    Fan,
    Find,
    Led,
    MoveArm,
    MoveServo,
    Resume,
    SetLight,
    SetMode,
    Signal,
    Stop,
    TakeLease,
)
from schemas import messages
from schemas.commands import COMMANDS, Verb
from schemas.gen import fleet_v1_pb2 as pb
from schemas.rights import Sender
from schemas.topics import PROTOBUF
from schemas.words import Light, Mode, Motion, Rank, Reason, ServoAction, SpeedStep
from tests.support.text_parts import has_parts

NOW = 1_800_000_000_000_000_000


def ask(
    verb: str, payload: Any, encoding: str = messages.JSON, *, longest_drive_s: float = 10.0, **more: Any
) -> Command:
    data = payload if isinstance(payload, bytes | None) else json.dumps(payload).encode()
    return parse(Request(verb, data, encoding, **more), NOW, longest_drive_s=longest_drive_s)


def refused(verb: str, payload: Any, encoding: str = messages.JSON, **more: Any) -> BadRequest:
    with pytest.raises(BadRequest) as caught:
        ask(verb, payload, encoding, **more)
    assert "\n" not in caught.value.words
    return caught.value


def parsed(request: Request) -> tuple[Command, str]:
    """Return the command. If the request is bad, return the known part of the command, and the reason."""
    try:
        return parse(request, NOW), ""
    except BadRequest as error:
        return error.command, error.words or "no words"


@pytest.mark.parametrize(
    ("verb", "payload", "what"),
    [
        *(("drive", {"motion": motion}, Drive(motion, 0.5)) for motion in Motion),
        ("drive", {"motion": "forward", "duration_s": 10}, Drive(Motion.FORWARD, 10.0)),
        ("drive", {"motion": "forward", "continues": True}, Drive(Motion.FORWARD, 0.5, continues=True)),
        ("drive", {"motion": "forward", "duration_s": 1e-3}, Drive(Motion.FORWARD, 1e-3)),
        *(("mode", {"mode": mode}, SetMode(mode)) for mode in Mode),
        ("led", {"r": 0, "g": 0, "b": 0}, Led(0, 0, 0)),
        ("led", {"r": 255, "g": 16, "b": 1}, Led(255, 16, 1)),
        *(("light", {"light": light}, SetLight(light)) for light in Light),
        ("servo", {"deg": 0}, AimServo(0)),
        ("servo", {"servo": "front", "deg": 180}, AimServo(180)),
        ("servo", {"action": "left"}, MoveServo(ServoAction.FRONT_LEFT)),
        ("servo", {"servo": "front", "action": "reset"}, MoveServo(ServoAction.FRONT_RESET)),
        ("servo", {"servo": "vertical", "action": "up"}, MoveServo(ServoAction.VERTICAL_UP)),
        ("servo", {"servo": "horizontal", "action": "right"}, MoveServo(ServoAction.HORIZONTAL_RIGHT)),
        ("arm", {"joint_deg": [0, 180, 1, 2, 3, 4]}, MoveArm((0, 180, 1, 2, 3, 4))),
        ("whistle", {}, Signal(Verb.WHISTLE)),
        ("speed", {"step": "up"}, ChangeSpeed(SpeedStep.UP)),
        ("speed", {"step": "down"}, ChangeSpeed(SpeedStep.DOWN)),
        ("fan", {}, Fan(None)),
        ("fan", {"state": "on"}, Fan(on=True)),
        ("fan", {"state": "off"}, Fan(on=False)),
        ("stop", {}, Stop()),
        ("stop", None, Stop()),
        ("estop", {"why": "smoke", "scope": "fleet"}, EmergencyStop("smoke", fleet_wide=True)),
        ("estop", {"why": "x" * 999, "scope": "car"}, EmergencyStop("x" * 200)),
        ("estop", None, EmergencyStop()),
        ("resume", {}, Resume()),
        ("resume", {"ids": ["a", "b"]}, Resume(("a", "b"))),
        ("lease", {}, TakeLease()),
        ("lease", {"release": True}, TakeLease(release=True)),
        ("find", {}, Find()),
    ],
)
def test_payload_is_parsed_to_command(verb: str, payload: Any, what: Action) -> None:
    command = ask(verb, payload)
    assert command.what == what
    assert (command.verb, command.sender, command.streamed) == (verb, Sender("anonymous", Rank.SCRIPT), False)
    assert (command.age_s, command.ttl_s) == (None, 0.5 if verb == "drive" else 2.0)
    assert len(command.id) == 32
    if payload is not None:
        message: Any = messages.message_class(COMMANDS[verb].message)(**payload)
        for encoding in (PROTOBUF, messages.encoding_of(COMMANDS[verb].message)):
            assert ask(verb, message.SerializeToString(), encoding).what == what


@pytest.mark.parametrize(("longest_drive_s", "lasts_s"), [(10.0, 0.5), (0.5, 0.5), (0.3, 0.3), (1e-06, 1e-06)])
def test_drive_without_duration_is_no_longer_than_allowed(longest_drive_s: float, lasts_s: float) -> None:
    for payload in ({"motion": "forward"}, {"motion": "forward", "continues": True}):
        what = ask("drive", payload, longest_drive_s=longest_drive_s).what
        assert isinstance(what, Drive)
        assert what.duration_s == lasts_s


def test_parser_knows_every_verb_once() -> None:
    for verb in COMMANDS:
        assert (verb, parsed(Request(verb, b"{}", messages.JSON))[0].verb) == (verb, verb)
    signals = [verb for verb, row in COMMANDS.items() if row.signal]
    assert sorted([*command_parser._WHAT, *PLAIN_ACTIONS, *signals, "drive"]) == sorted(COMMANDS), "each verb once"


def test_plain_action_fields_are_flags() -> None:
    found = {field.name: field.type for action in PLAIN_ACTIONS.values() for field in fields(action)}
    assert all(each is bool for each in found.values())


def test_signal_message_has_duration_at_most() -> None:
    common = {field.name for field in pb.StopCommand.DESCRIPTOR.fields}
    for row in COMMANDS.values():
        if row.signal:
            own = {field.name for field in messages.message_class(row.message).DESCRIPTOR.fields} - common
            assert own == ({"duration_s"} if row.max_duration_s else set())


def test_signal_duration_has_limit_of_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """Made from `lend`, whose message has a duration."""
    monkeypatch.setattr(command_parser, "COMMANDS", {**COMMANDS, "lend": COMMANDS["lend"]._replace(signal=True)})
    monkeypatch.delitem(command_parser._WHAT, "lend")
    assert ask("lend", {"duration_s": 86_400}).what == Signal(Verb.LEND, 86_400.0)
    for wrong in (86_401, 0, -1, "NaN", "Infinity"):
        assert "duration_s" in refused("lend", {"duration_s": wrong}).words
    assert "duration_s 0: " in refused("lend", {}).words
    row = COMMANDS["lend"]._replace(signal=True, min_duration_s=2.0)
    monkeypatch.setattr(command_parser, "COMMANDS", {**COMMANDS, "lend": row})
    assert ask("lend", {"duration_s": 2}).what == Signal(Verb.LEND, 2.0)
    assert "duration_s 1.9: " in refused("lend", {"duration_s": 1.9}).words


@pytest.mark.parametrize(
    ("verb", "payload", "reason", "words"),
    [
        ("jump", {}, Reason.UNSUPPORTED, "'jump' … command. … : drive, "),
        ("", {}, Reason.UNSUPPORTED, "''"),
        ("drive", None, Reason.BAD_VALUE, "drive … payload: … fleet.v1.DriveCommand or its JSON"),
        ("resume", None, Reason.BAD_VALUE, "only stop and estop "),
        ("drive", {}, Reason.BAD_VALUE, "motion is missing: … stop, forward, "),
        ("drive", {"motion": "Forward"}, Reason.BAD_VALUE, "motion 'Forward'. … mean forward?"),
        ("drive", {"motion": "forward", "duration_s": 0}, Reason.BAD_VALUE, "duration_s 0: … than 0"),
        ("drive", {"motion": "forward", "duration_s": -1}, Reason.BAD_VALUE, "duration_s -1"),
        (
            "drive",
            {"motion": "forward", "duration_s": 10.1},
            Reason.BAD_VALUE,
            "10.1 s … 10 s (longest_drive_s ",
        ),
        ("drive", {"motion": "forward", "duration_s": "NaN"}, Reason.BAD_VALUE, "duration_s nan"),
        ("drive", {"motion": "forward", "duration_s": "Infinity"}, Reason.BAD_VALUE, "duration_s inf"),
        ("drive", {"motion": "forward", "ttl_s": 0}, Reason.BAD_VALUE, "ttl_s 0"),
        ("drive", {"motion": "forward", "ttl_s": "NaN"}, Reason.BAD_VALUE, "ttl_s nan"),
        ("drive", {"motion": "forward", "ttl_s": 3601}, Reason.BAD_VALUE, "at most 3600 s"),
        ("drive", {"motion": "forward", "speed": 3}, Reason.BAD_VALUE, "speed"),
        ("drive", {"motion": 1}, Reason.BAD_VALUE, "JSON of fleet.v1.DriveCommand"),
        ("drive", {"motion": "forward", "kind": "boss"}, Reason.BAD_VALUE, "person, script, coordinator"),
        ("drive", {"motion": "forward", "sender": "a/b"}, Reason.BAD_VALUE, "sender 'a/b' is not allowed"),
        ("drive", {"motion": "forward", "sender": "a\nb"}, Reason.BAD_VALUE, "control characters"),
        ("drive", {"motion": "forward", "id": "x" * 129}, Reason.BAD_VALUE, "id of 129 … too long"),
        ("mode", {"mode": "swim"}, Reason.BAD_VALUE, "mode 'swim': … manual, "),
        ("led", {"r": 1, "b": 1}, Reason.BAD_VALUE, "g is missing: … 0..255 "),
        ("led", {"r": 1, "g": 256, "b": 1}, Reason.BAD_VALUE, "g: 256, … 0..255"),
        ("light", {"light": "pink"}, Reason.BAD_VALUE, "light 'pink'"),
        ("servo", {}, Reason.BAD_VALUE, ": … left, right, reset, or deg 0..180"),
        ("servo", {"deg": 181}, Reason.BAD_VALUE, "deg: 181, … 0..180"),
        ("servo", {"deg": -1}, Reason.BAD_VALUE, "deg"),
        ("servo", {"deg": 9, "action": "left"}, Reason.BAD_VALUE, "without an action"),
        ("servo", {"servo": "vertical", "deg": 9}, Reason.BAD_VALUE, "only the front "),
        ("servo", {"servo": "vertical", "action": "left"}, Reason.BAD_VALUE, " up, down, reset"),
        ("servo", {"servo": "rear", "action": "left"}, Reason.BAD_VALUE, "servo 'rear'"),
        ("arm", {"joint_deg": [1, 2]}, Reason.BAD_VALUE, "joint_deg: 2 values, allowed are 6"),
        ("arm", {"joint_deg": [1, 2, 3, 4, 5, 999]}, Reason.BAD_VALUE, "joint_deg[5]: 999"),
        ("speed", {}, Reason.BAD_VALUE, "step is missing: … up, down"),
        ("fan", {"state": "fast"}, Reason.BAD_VALUE, " on and off, or leave it out"),
    ],
)
def test_malformed_command_refusals(verb: str, payload: Any, reason: Reason, words: str) -> None:
    error = refused(verb, payload)
    assert error.reason is reason
    assert has_parts(error.words, words)


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        ([1], "JSON of fleet.v1.StopCommand"),
        ({"sender": "\ud800"}, "not the JSON"),
        ({"sender": "a/b"}, "sender 'a/b' is not allowed"),
        ({"kind": "boss"}, "kind 'boss': "),
        ({"ttl_s": 0}, "ttl_s 0"),
        ({"id": "x" * 200}, "too long"),
    ],
)
def test_stop_with_invalid_fields_is_still_a_stop(payload: Any, words: str) -> None:
    stop = ask("stop", payload)
    assert stop.what == Stop()
    assert ": stop: " in stop.note
    assert words in stop.note
    assert ask("estop", payload).what == EmergencyStop()


@pytest.mark.parametrize("wrong", [{"ttl_s": "soon"}, {"colour": 1}, {"kind": "boss"}, {"id": "x" * 200}], ids=str)
def test_invalid_estop_keeps_scope_and_reason(wrong: dict[str, Any]) -> None:
    stop = ask("estop", {"why": "smoke", "scope": "fleet", **wrong})
    assert stop.what == EmergencyStop("smoke", fleet_wide=True)
    assert "in spite of" in stop.note
    as_message = pb.EstopCommand(why="smoke", scope="fleet", kind="boss").SerializeToString()
    assert ask("estop", as_message, f"{PROTOBUF};fleet.v1.EstopCommand").what == EmergencyStop("smoke", fleet_wide=True)


def test_estop_of_all_without_id_is_same_for_every_gateway() -> None:
    first, second = (ask("estop", {"why": "smoke", "scope": "fleet"}, by_wildcard=True) for _ in range(2))
    assert first.id == second.id
    assert ask("estop", {"why": "fire", "scope": "fleet"}, by_wildcard=True).id != first.id
    assert ask("estop", {"why": "smoke", "scope": "fleet"}).id != first.id, "of one car: who asks twice means two"
    assert ask("resume", {}, by_wildcard=True).id != ask("resume", {}, by_wildcard=True).id


def test_estop_of_unknown_scope_stops_this_car() -> None:
    assert ask("estop", {"scope": "world", "sender": "mia"}).what == EmergencyStop()
    assert "car (the default) and fleet" in ask("estop", {"scope": "world"}).note


def test_refusal_is_recorded_under_given_id_and_sender() -> None:
    error = refused("drive", {"motion": "up", "id": "abc", "sender": "mia", "kind": "person"})
    assert (error.command.id, error.command.sender) == ("abc", Sender("mia", Rank.PERSON))


def test_longest_drive_limit_is_configurable() -> None:
    payload = {"motion": "forward", "duration_s": 60}
    assert ask("drive", payload, longest_drive_s=60.0).what == Drive(Motion.FORWARD, 60.0)
    assert "at most 59 s" in refused("drive", payload, longest_drive_s=59.0).words


def test_refused_streamed_command_is_still_streamed() -> None:
    for payload in ({"motion": "up"}, {}, b"\xff", None):
        error = refused("drive", payload, sampled_ns=NOW)
        assert error.command.streamed, "or each of 25 a second is recorded"


@pytest.mark.parametrize("encoding", ["", "zenoh/bytes", "text/plain", "application/json", "application/json;x"])
def test_payload_without_protobuf_encoding_is_read_as_json(encoding: str) -> None:
    assert ask("drive", {"motion": "back"}, encoding).what == Drive(Motion.BACK)


def test_message_of_other_verb_is_refused() -> None:
    words = refused("drive", pb.LedCommand(r=1).SerializeToString(), messages.encoding_of("fleet.v1.LedCommand")).words
    assert words.startswith("drive: ")
    assert "fleet.v1.LedCommand" in words
    assert words.endswith("fleet.v1.DriveCommand")


@pytest.mark.parametrize("encoding", ["", messages.JSON, PROTOBUF])
def test_zero_bytes_are_a_message_without_fields(encoding: str) -> None:
    assert ask("whistle", b"", encoding).what == Signal(Verb.WHISTLE)
    assert ask("stop", b"", encoding).what == Stop()
    assert "motion is missing" in refused("drive", b"", encoding).words


@pytest.mark.parametrize("verb", COMMANDS)
def test_wildcard_is_for_fleet_commands_only(verb: str) -> None:
    if verb in ("stop", "estop", "resume", "pause", "unpause"):
        assert ask(verb, {}, by_wildcard=True).verb == verb
    else:
        assert "no wildcard" in refused(verb, {}, by_wildcard=True).words


@pytest.mark.parametrize(
    ("asked_ns", "sampled_ns", "age_s"),
    [
        (None, None, None),
        (NOW - 1_500_000_000, None, 1.5),
        (NOW + 1_500_000_000, None, -1.5),
        (NOW + 3600 * 1_000_000_000, NOW, -3600.0),
        (None, NOW + 3600 * 1_000_000_000, 0.0),
        (None, NOW - 2_000_000_000, 2.0),
        (NOW - 250_000_000, NOW - 9_000_000_000, 0.25),
        (0, None, NOW / 1e9),
    ],
)
def test_age_is_from_asked_else_from_the_sample_else_fresh(
    asked_ns: int | None, sampled_ns: int | None, age_s: float | None
) -> None:
    message = pb.DriveCommand(motion="forward", ttl_s=7)
    if asked_ns is not None:
        message.asked.seconds, message.asked.nanos = divmod(asked_ns, 1_000_000_000)
    command = ask("drive", message.SerializeToString(), PROTOBUF, sampled_ns=sampled_ns)
    assert command.age_s == (None if age_s is None else pytest.approx(age_s))
    assert command.ttl_s == 7
    assert command.streamed is (sampled_ns is not None)


VALUES = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.floats(),
        st.text(),
        st.sampled_from(["forward", "NaN", "-Infinity", "up", "front"]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=6), st.dictionaries(st.text(), inner, max_size=3)),
    max_leaves=6,
)
FIELDS = sorted(
    {field for row in COMMANDS.values() for field in messages.message_class(row.message).DESCRIPTOR.fields_by_name}
)
JSONS = st.one_of(VALUES, st.dictionaries(st.sampled_from(FIELDS), VALUES)).map(
    lambda value: json.dumps(value).encode()
)
WIRE = st.binary(max_size=40).map(lambda tail: pb.DriveCommand(motion="forward", id="x").SerializeToString() + tail)


@settings(max_examples=400)
@given(
    st.sampled_from([*COMMANDS, "jump"]),
    st.one_of(st.none(), st.binary(), st.text().map(lambda text: text.encode(errors="replace")), JSONS, WIRE),
    st.one_of(st.sampled_from([messages.JSON, PROTOBUF, ""]), st.text()),
    st.one_of(st.none(), st.integers(0, 1 << 63)),
    st.booleans(),
)
def test_any_bytes_on_any_verb_are_command_or_bad_request(
    verb: str, payload: bytes | None, encoding: str, sampled_ns: int | None, by_wildcard: bool
) -> None:
    request = Request(verb, payload, encoding, sampled_ns=sampled_ns, by_wildcard=by_wildcard)
    command, words = parsed(request)
    assert words != "no words"
    assert command.verb == verb
    assert command.streamed is request.streamed
    assert command.age_s is None or math.isfinite(command.age_s)
    assert 0 < command.ttl_s <= 3600


def test_deep_json_is_refused_in_no_time() -> None:
    began = time.monotonic()
    assert "not the JSON" in refused("drive", b"[" * 100_000).words
    assert time.monotonic() - began < 10


def test_unread_payload_is_refused_but_stop_is_obeyed() -> None:
    error = refused("drive", None, why_unread="it is too large")
    assert error.reason is Reason.BAD_VALUE
    assert error.words.startswith("drive: ")
    assert "too large" in error.words
    stop = ask("stop", None, why_unread="it is too large")
    assert stop.what == Stop()
    assert "too large" in stop.note
    assert ask("estop", None, why_unread="too large", by_wildcard=True).what == EmergencyStop()
