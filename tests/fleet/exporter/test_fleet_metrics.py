"""The values of the metrics by what was heard. Time is an argument."""

from typing import Any

import pytest

from fleet.exporter.fleet_metrics import MAX_EXPORTED_CARS, FleetMetrics
from fleet.exporter.metrics import OTHER
from schemas import messages, topics
from schemas.bus import Sample
from schemas.gen import fleet_v1_pb2 as pb

NOW = 1000.0


def sample(key: str, message: Any) -> Sample:
    encoding = messages.encoding_of(message.DESCRIPTOR.full_name)
    return Sample(key, message.SerializeToString(), encoding, 0, 0)


def car(metrics: FleetMetrics, name: str, now: float = NOW) -> None:
    """Let a gateway come and say all that it must."""
    metrics.observer.on_token(name, now, alive=True)
    for topic, message in (
        ("link", pb.Link(state="online", rx_bytes=10, rejects={"truncated": 2, "overlong": 1}, last_rx_s=0.5)),
        ("mode", pb.Mode(asked="manual")),
        ("motion", pb.Motion(motion="stop")),
        ("safety", pb.Safety(motors="off", estops=[pb.Estop(id="a"), pb.Estop(id="b")])),
        ("health", pb.Health(bus_drops=7, rss_mb=50)),
    ):
        message.boot_id = "1"
        metrics.on_sample(sample(f"fleet/{name}/state/{topic}", message), now)


def found(metrics: FleetMetrics, now: float = NOW) -> dict[tuple[str, ...], float]:
    return {(metric.name, *labels): value for metric, labels, value in metrics.values(now)}


def test_car_has_the_values_of_its_messages() -> None:
    metrics = FleetMetrics()
    car(metrics, "red")
    values = found(metrics, NOW + 1)
    assert values["fleet_car_up", "red"] == 1
    assert values["fleet_car_ready", "red"] == 1
    assert (values["fleet_car_link", "red", "online"], values["fleet_car_link", "red", "lost"]) == (1, 0)
    assert (values["fleet_car_motors", "red", "off"], values["fleet_car_mode", "red", "manual"]) == (1, 1)
    assert (values["fleet_car_estops", "red"], values["fleet_car_held", "red"]) == (2, 0)
    assert values["fleet_car_rejected_frames", "red"] == 3
    assert values["fleet_car_silence_seconds", "red"] == 1.5
    assert values["fleet_car_gateway_memory_bytes", "red"] == 50e6
    assert values["fleet_car_bus_drops", "red"] == 7
    assert values["fleet_car_message_age_seconds", "red", "state/link"] == 1
    assert ("fleet_car_battery_volts", "red") not in values


def test_stale_metric_has_no_value_and_gone_gateway_is_down() -> None:
    metrics = FleetMetrics()
    car(metrics, "red")
    late = NOW + (topics.TOPICS["state/link"].stale_after_s or 0) + 1
    names = {name for name, *_ in found(metrics, late)}
    assert names == {"fleet_car_up", "fleet_car_ready", "fleet_car_message_age_seconds"}
    assert found(metrics, late)["fleet_car_ready", "red"] == 0
    metrics.observer.on_token("red", late, alive=False)
    assert found(metrics, late) == {("fleet_car_up", "red"): 0}
    assert [*metrics.values(late, sees_gateways=False)] == []


def test_each_command_phase_counts_once_with_closed_labels() -> None:
    metrics = FleetMetrics()
    car(metrics, "red")
    for event in (
        pb.CommandEvent(id="1", verb="drive", phase="asked"),
        pb.CommandEvent(id="1", verb="drive", phase="sent", count=20),
        pb.CommandEvent(id="1", verb="drive", phase="sent", count=20, basis="sent"),
        pb.CommandEvent(id="2", verb="drive", phase="sent"),
        pb.CommandEvent(id="3", verb="mode", phase="rejected", reason="leased"),
        pb.CommandEvent(id="4", verb="x1", phase="rejected", reason="x2"),
        pb.CommandEvent(id="4", verb="x1", phase="x3"),
    ):
        metrics.on_sample(sample("fleet/red/event/command", event), NOW)
        metrics.on_sample(sample("fleet/stranger/event/command", event), NOW)
    values = found(metrics)
    assert {key[1:]: value for key, value in values.items() if key[0] == "fleet_car_commands"} == {
        ("red", "drive", "asked"): 1,
        ("red", "drive", "sent"): 21,
        ("red", "mode", "rejected"): 1,
        ("red", OTHER, "rejected"): 1,
    }
    assert {key[1:]: value for key, value in values.items() if key[0] == "fleet_car_refusals"} == {
        ("red", "leased"): 1,
        ("red", OTHER): 1,
    }


def test_word_that_is_none_counts_as_unknown() -> None:
    metrics = FleetMetrics()
    car(metrics, "red")
    metrics.on_sample(sample("fleet/red/state/mode", pb.Mode(asked="made_up", boot_id="1")), NOW)
    values = found(metrics)
    assert values["fleet_car_mode", "red", "unknown"] == 1
    assert not [key for key in values if "made_up" in key]


def test_invented_cars_are_bounded() -> None:
    metrics = FleetMetrics()
    for number in range(MAX_EXPORTED_CARS + 20):
        car(metrics, f"car{number:03}")
    for number in range(1000):
        metrics.on_sample(sample(f"fleet/ghost{number}/state/link", pb.Link(state="online", boot_id="1")), NOW)
        metrics.forget(NOW)
    assert len({key[1] for key in found(metrics)}) == MAX_EXPORTED_CARS
    assert not [key for key in found(metrics) if key[1].startswith("ghost")]


@pytest.mark.parametrize(("after_s", "there"), [(1.0, True), (10.0, False)])
def test_recorder_that_has_ended_has_no_state(after_s: float, there: bool) -> None:
    metrics = FleetMetrics()
    status = pb.Recording(state="recording", bytes=5, drops={"a": 1, "b": 2})
    metrics.on_sample(sample("fleet/@recorder/status", status), NOW)
    values = found(metrics, NOW + after_s)
    assert (values.get(("fleet_recorder", "recording")) == 1) is there
    assert (values.get(("fleet_recorder_dropped_messages",)) == 3) is there


def test_payload_that_is_none_changes_nothing() -> None:
    metrics = FleetMetrics()
    car(metrics, "red")
    before = found(metrics)
    for key in ("fleet/red/state/link", "fleet/red/event/command", "fleet/@recorder/status", "fleet"):
        metrics.on_sample(Sample(key, b"\xff\xff", "text/plain", 0, 0), NOW)
    assert found(metrics) == before
