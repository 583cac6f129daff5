"""Makes the Grafana dashboard from the table of metrics. `fleet exporter --dashboard` prints it. Pure.

deploy/grafana.json is a copy of it.

The data source is an input of the dashboard: Grafana asks for it when somebody imports the dashboard.
"""

from typing import Any, Final

from fleet.exporter.metrics import METRICS, Metric, MetricKind, Unit

_SOURCE: Final = {"type": "prometheus", "uid": "${DS_PROMETHEUS}"}
_COLUMNS: Final = 24  # of Grafana's grid
_WIDTH: Final = 12
_HEIGHT: Final = 7
_WORDS: Final = ("state", "mode")
"""Labels whose values are words. Such a metric has one series for each word: 1 if the word applies, else 0. A time line
shows the word that applies."""


def dashboard() -> dict[str, Any]:
    """Return the dashboard, with a panel for each title in the table."""
    by_title: dict[str, list[Metric]] = {}
    for metric in METRICS:
        by_title.setdefault(metric.panel, []).append(metric)
    panels = [_panel(number, title, shown) for number, (title, shown) in enumerate(by_title.items())]
    return {
        "__inputs": [{"name": "DS_PROMETHEUS", "label": "Prometheus", "type": "datasource", "pluginId": "prometheus"}],
        "title": "Car fleet",
        "uid": "car-fleet",
        "schemaVersion": 39,
        "refresh": "5s",
        "time": {"from": "now-15m", "to": "now"},
        "templating": {
            "list": [
                {
                    "name": "car",
                    "label": "Car",
                    "type": "query",
                    "datasource": _SOURCE,
                    "query": {"query": "label_values(fleet_car_up, car)", "refId": "cars"},
                    "definition": "label_values(fleet_car_up, car)",
                    "includeAll": True,
                    "multi": True,
                    "refresh": 2,
                    "sort": 1,
                    "current": {"text": "All", "value": "$__all"},
                }
            ]
        },
        "panels": panels,
    }


def _panel(number: int, title: str, metrics: list[Metric]) -> dict[str, Any]:
    per_row = _COLUMNS // _WIDTH
    is_line_of_words = any(label in _WORDS for label in metrics[0].labels)
    return {
        "id": number + 1,
        "title": title,
        "description": "; ".join(metric.about for metric in metrics),
        "type": "state-timeline" if is_line_of_words else "timeseries",
        "datasource": _SOURCE,
        "gridPos": {
            "x": number % per_row * _WIDTH,
            "y": number // per_row * _HEIGHT,
            "w": _WIDTH,
            "h": _HEIGHT,
        },
        "fieldConfig": {"defaults": {"unit": _unit(metrics[0]), "min": 0}, "overrides": []},
        "targets": [
            {
                "refId": chr(ord("A") + index),
                "datasource": _SOURCE,
                "expr": _expression(metric),
                "legendFormat": _legend(metric, shared=len(metrics) > 1),
            }
            for index, metric in enumerate(metrics)
        ],
    }


def _unit(metric: Metric) -> str:
    if metric.kind is MetricKind.COUNTER:
        return "Bps" if metric.unit is Unit.BYTES else "none"
    return metric.unit


def _expression(metric: Metric) -> str:
    """Return the expression to draw: the growth of a counter, the word that applies, or else the value."""
    names = metric.label_names
    selected = f'{metric.sample}{{car=~"$car"}}' if "car" in names else metric.sample
    if metric.kind is MetricKind.COUNTER:
        grown = f"rate({selected}[1m])" if metric.unit is Unit.BYTES else f"increase({selected}[1m])"
        return f"sum by ({', '.join(names)}) ({grown})" if names else grown
    return f"{selected} == 1" if any(label in _WORDS for label in metric.labels) else selected


def _legend(metric: Metric, *, shared: bool) -> str:
    words = [f"{{{{{name}}}}}" for name in metric.label_names]
    if shared or not words:
        words.append(metric.name.removeprefix("fleet_").removeprefix("car_").replace("_", " "))
    return " ".join(words)
