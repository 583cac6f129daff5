"""Sessions of which the schemas lack fields of ours, or have them with other types: other versions, other programs."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from schemas import messages
from tests.fleet.recording.tools.every_type import EACH, filled, keys_and_types
from tests.support.in_process import fleet
from tests.support.random_session import Mixed

OTHER_TYPE = {
    FieldDescriptorProto.TYPE_STRING: FieldDescriptorProto.TYPE_BOOL,
    FieldDescriptorProto.TYPE_DOUBLE: FieldDescriptorProto.TYPE_STRING,
    FieldDescriptorProto.TYPE_BYTES: FieldDescriptorProto.TYPE_DOUBLE,
}


def lack(_: FieldDescriptorProto) -> bool:
    """Remove a field."""
    return False


def retype(field: FieldDescriptorProto) -> bool:
    """Give a field another type."""
    if field.type != FieldDescriptorProto.TYPE_MESSAGE:
        field.type = OTHER_TYPE.get(field.type, FieldDescriptorProto.TYPE_BYTES)
        field.ClearField("type_name")
    return True


def repeat(field: FieldDescriptorProto) -> bool:
    """Make a list of a field."""
    if field.type == FieldDescriptorProto.TYPE_MESSAGE:
        return True
    field.label = FieldDescriptorProto.LABEL_REPEATED
    field.ClearField("oneof_index")
    field.ClearField("proto3_optional")
    return True


def keep(_: FieldDescriptorProto) -> bool:
    """Change nothing."""
    return True


Change = Callable[[FieldDescriptorProto], bool]
PARTS = 3


def changed(name: str, changes: Sequence[Change], part: int) -> FileDescriptorSet:
    """Return the schema of a message. Its fields are changed in turn: each one differently in each of three parts."""
    files = FileDescriptorSet.FromString(messages.descriptor_set(name))
    for message in (each for file in files.file if file.package == "fleet.v1" for each in file.message_type):
        fields = [each for number, each in enumerate(message.field) if changes[(number + part) % PARTS](each)]
        for each in fields:
            each.ClearField("oneof_index")
            each.ClearField("proto3_optional")
        kept = [FieldDescriptorProto.FromString(each.SerializeToString()) for each in fields]
        del message.field[:], message.oneof_decl[:]
        message.field.extend(kept)
    return files


def make(path: Path, changes: Sequence[Change], part: int) -> int:
    """Write a session with each type of message, and return the number of its messages."""
    made = Mixed(path)
    schemas: dict[str, Any] = {}
    for key, name in keys_and_types().items():
        files = changed(name, changes, part)
        pool = DescriptorPool()
        for file in files.file:
            pool.Add(file)
        schemas[key] = GetMessageClass(pool.FindMessageTypeByName(name))
        made._schemas[name, "protobuf"] = made.writer.register_schema(name, "protobuf", files.SerializeToString())
    for number in range(EACH):
        for key, message_class in schemas.items():
            message = message_class() if number == EACH - 1 else filled(message_class(), number)
            made.put(key, message.DESCRIPTOR.full_name, message.SerializeToString())
    return made.close().total()


@pytest.mark.parametrize("part", range(PARTS))
def test_missing_fields_leave_no_message_out(tmp_path: Path, part: int) -> None:
    path = tmp_path / "other.mcap"
    count = make(path, (lack, keep, keep), part)
    done = fleet("replay", path, "--save", tmp_path / "x.rrd")
    assert (done.returncode, "not shown: " in done.stderr) == (0, False), done
    assert f": {count} messages" in done.stdout


@pytest.mark.parametrize("part", range(PARTS))
def test_other_fields_hide_no_message(tmp_path: Path, part: int) -> None:
    """Each of these commands ended with a traceback, or showed nothing of the session."""
    place = tmp_path / "sessions"
    place.mkdir()
    path = place / "other.mcap"
    count = make(path, (lack, retype, repeat), part)
    for form in ("csv", "parquet", "ros2", "foxglove"):
        done = fleet("sessions", "export", path, f"--{form}", tmp_path / form)
        assert (done.returncode, f": {count} messages" in done.stdout) == (0, True), (form, done)
    done = fleet("replay", path, "--save", tmp_path / "x.rrd")
    left_out = sum(int(line.split()[2]) for line in done.stderr.splitlines() if line.startswith("not shown: "))
    assert (done.returncode, f": {count - left_out} messages" in done.stdout) == (0, True), done
    verdict = json.loads(fleet("sessions", "verify", path, "--json").stdout)
    assert (verdict["messages"], verdict["damage"], verdict["undecoded"]) == (count, {}, {})
    assert json.loads(fleet("sessions", "info", path, "--json").stdout)["messages"] == count
    assert fleet("find", "range_m < 1e9", place).returncode in (0, 1)
    assert fleet("query", "SELECT count(*) FROM event_command", place, "--csv").returncode == 0
    assert fleet("query", "--tables", place).returncode == 0
