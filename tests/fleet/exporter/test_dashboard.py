"""The board of Grafana: it is what the table makes, and shows all of the table."""

import json
import re
from pathlib import Path

from fleet.exporter.dashboard import dashboard
from fleet.exporter.metrics import METRICS

FILE = Path(__file__).parents[3] / "deploy" / "grafana.json"


def test_file_is_what_the_table_makes() -> None:
    assert json.loads(FILE.read_text()) == dashboard(), "fleet exporter --dashboard > deploy/grafana.json"


def test_each_metric_has_panel_and_panels_do_not_overlap() -> None:
    panels = dashboard()["panels"]
    expressions = [target["expr"] for panel in panels for target in panel["targets"]]
    shown = [re.findall(r"fleet_[a-z_]+", expression) for expression in expressions]
    assert sorted(name for names in shown for name in names) == sorted(metric.sample for metric in METRICS)
    places = {(panel["gridPos"]["x"], panel["gridPos"]["y"]) for panel in panels}
    assert len(places) == len({panel["id"] for panel in panels}) == len(panels)
    assert all(panel["gridPos"]["x"] + panel["gridPos"]["w"] <= 24 for panel in panels)
