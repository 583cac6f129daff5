"""Serves what the bus says of a fleet to Prometheus, and makes the board of Grafana that shows it.

`metrics` is the one table of metrics. `fleet_metrics` keeps what was heard and computes their values, pure. `exporter`
is the process. `dashboard` makes the board from the same table.
"""
