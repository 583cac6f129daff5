"""A command in the ledger: requested, decided, on the wire, shown."""

from fleet.console.car_view import CarView
from fleet.console.command_ledger import MAX_COMMANDS, CommandLedger
from schemas.gen import fleet_v1_pb2 as pb


def event(phase: str, command_id: str = "a", **fields: object) -> pb.CommandEvent:
    return pb.CommandEvent(id=command_id, verb="stop", sender="mia", kind="person", phase=phase, **fields)  # type: ignore[arg-type]  # in turn


def test_command_has_its_course_its_frames_and_its_evidence() -> None:
    ledger = CommandLedger()
    ledger.on_event(event("asked"))
    ledger.on_event(event("sent", took_s=0.05))
    ledger.on_event(event("sent", took_s=0.05))
    ledger.on_frame(pb.TxFrame(command_id="a", data=b"$4WD,MODE00#", written=True))
    ledger.on_frame(pb.TxFrame(command_id="a", data=b"$0#", written=False))
    ledger.on_frame(pb.TxFrame(command_id="none", data=b"x", written=True))
    ledger.on_event(event("complete", basis="shown", evidence=["a pause of 1.9 s"]))
    (row,) = ledger.as_list()
    assert row == {
        "at_ms": 0,
        "requested": "stop by mia (person)",
        "decided": "asked → sent after 0.05 s → complete",
        "wire": "$4WD,MODE00# $0# NOT written",
        "evidence": "shown; a pause of 1.9 s",
        "bad": False,
    }


def test_refusal_is_marked_and_old_commands_are_forgotten() -> None:
    ledger = CommandLedger()
    for number in range(MAX_COMMANDS + 5):
        ledger.on_event(event("rejected", str(number), reason="held", words="red is on hold"))
    rows = ledger.as_list()
    assert len(rows) == MAX_COMMANDS
    assert rows[0]["decided"] == "rejected: red is on hold"
    assert all(row["bad"] for row in rows)


def test_panel_has_the_doctors_lines() -> None:
    view = CarView("red", "#ff0000")
    view.on_presence(0.0, present=True)
    view.on_message("state/link", pb.Link(state="lost", reason="unplugged", since_s=4), 1.0)
    view.on_message("event/command", event("rejected", reason="link_down"), 2.0)
    lost = "The link has been lost for 4 s: unplugged. Type: fleet scan"
    assert view.diagnose(4.0)["findings"] == [lost]
    shown = view.diagnose(5.0)  # its gateway has said nothing for 4 s
    hangs, *others = shown["findings"]
    assert (hangs.rpartition("Type: ")[2], others) == ("fleet logs red", [lost])
    facts = {name: words for name, words, _ in shown["facts"]}
    assert facts["link"].startswith("lost (4 s old) for 4 s, 0 frames in")
    assert facts["refused"] == "stop of mia 3 s ago: rejected [link_down]"
    assert "services" not in facts


def test_frame_before_event_of_its_command_is_shown() -> None:
    ledger = CommandLedger()
    for number in range(MAX_COMMANDS):
        ledger.on_frame(pb.TxFrame(command_id=f"no event {number}", data=b"x", written=True))
    ledger.on_frame(pb.TxFrame(data=b"x", written=True))  # a frame of no command
    ledger.on_frame(pb.TxFrame(command_id="a", data=b"$0#", written=True))
    ledger.on_event(event("asked"))
    ledger.on_frame(pb.TxFrame(command_id="a", data=b"$1#", written=True))
    assert [row["wire"] for row in ledger.as_list()] == ["$0# $1#"]
