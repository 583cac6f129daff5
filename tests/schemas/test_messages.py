"""Every topic and command has a message. Payloads are protobuf or JSON."""

import json

import pytest
from google.protobuf import descriptor_pb2
from google.protobuf.descriptor import FieldDescriptor

from schemas import messages, topics
from schemas.commands import COMMANDS
from schemas.gen import fleet_v1_pb2 as pb
from schemas.words import BatteryLevel, LinkState, Mode, Motion, Verdict

SERVICES = {"fleet.v1.DownCommand", "fleet.v1.ReloadCommand"}
"""Commands of the fleet's own services."""
NAMES = sorted(
    {topic.message for topic in topics.TOPICS.values()}
    | {row.message for row in COMMANDS.values()}
    | {topics.RESULT}
    | SERVICES
)


@pytest.mark.parametrize("name", NAMES)
def test_every_name_of_the_table_is_a_message(name: str) -> None:
    message = messages.message_class(name)()
    assert message.DESCRIPTOR.full_name == name
    assert messages.parse(name, message.SerializeToString(), messages.encoding_of(name)) == message
    assert messages.parse(name, messages.to_json(message).encode(), messages.JSON) == message
    files = descriptor_pb2.FileDescriptorSet.FromString(messages.descriptor_set(name)).file
    known: set[str] = set()
    for file in files:
        assert set(file.dependency) <= known, "dependencies come first"
        known.add(file.name)


@pytest.mark.parametrize("topic", topics.TOPICS.values(), ids=str)
def test_units_name_fields_of_the_message(topic: topics.Topic) -> None:
    fields = messages.message_class(topic.message).DESCRIPTOR.fields_by_name
    assert set(topic.units) <= set(fields)
    if topic.message.startswith("fleet.v1."):
        assert [fields[name].number for name in ("stamp", "car", "seq", "boot_id")] == [1, 2, 3, 4]


def test_no_enum_is_on_the_wire() -> None:
    """Rerun's MCAP importer crashes on an enum number that is not in the schema."""
    assert not [name for name, kind in pb.DESCRIPTOR.enum_types_by_name.items() if kind]
    for message in pb.DESCRIPTOR.message_types_by_name.values():
        assert not [field.name for field in message.fields if field.enum_type]


def test_unmeasured_field_is_left_out_of_json() -> None:
    known = json.loads(messages.to_json(pb.Range(no_echo=True)))
    assert "range_m" not in known
    assert known["no_echo"] is True


@pytest.mark.parametrize(
    ("payload", "encoding", "words"),
    [
        (b"{", messages.JSON, "is not the JSON of fleet.v1.DriveCommand"),
        (b'{"motoin": "forward"}', messages.JSON, "motoin"),
        (b'{"duration_s": "soon"}', messages.JSON, "duration_s"),
        (b"\xff\xfe", messages.JSON, "is not the JSON"),
        (b"\xff\xff", topics.PROTOBUF, "does not parse as fleet.v1.DriveCommand"),
        (b"", "application/protobuf;fleet.v1.ModeCommand", "this key takes fleet.v1.DriveCommand"),
    ],
)
def test_bad_payloads_say_why_in_one_line(payload: bytes, encoding: str, words: str) -> None:
    with pytest.raises(messages.BadPayload, match=words) as caught:
        messages.parse("fleet.v1.DriveCommand", payload, encoding)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("topic", topics.TOPICS.values(), ids=str)
def test_words_and_ranges_name_fields_of_the_message(topic: topics.Topic) -> None:
    fields = messages.message_class(topic.message).DESCRIPTOR.fields_by_name
    assert all(fields[name].cpp_type == FieldDescriptor.CPPTYPE_STRING for name in topic.words)
    numbers = (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_UINT32, FieldDescriptor.CPPTYPE_INT32)
    assert all(fields[name].cpp_type in numbers for name in topic.ranges)


def test_words_of_the_table_are_those_that_gateways_publish() -> None:
    words = {name: set(each) for topic in topics.CAR_TOPICS for name, each in topic.words.items()}
    assert words["asked"] == words["inferred"] == {*Mode, "unknown"}
    assert words["motion"] == {*Motion, "unknown"}
    assert words["verdict"] == {*Verdict}
    assert words["state"] == {*LinkState}
    assert words["level"] == {*BatteryLevel}
