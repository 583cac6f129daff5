"""Serves the state of a fleet to Prometheus, and makes the Grafana dashboard that shows it.

`metrics` is the one table of metrics. `fleet_metrics` stores the newest messages and computes the values of the
metrics, and is pure. `exporter` is the process. `dashboard` makes the dashboard from the same table.
"""
