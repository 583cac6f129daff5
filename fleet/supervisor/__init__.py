"""`fleet up`: starts all processes of a fleet, restarts what fails, and ends with every car stopped.

Read `supervisor` first. `spec` says what is to run, `processes` and `child` run it, `restart_policy`, `admission` and
`hang` decide when (pure), `shutdown` ends it in order, `service` answers on the bus, `status_table` shows it.
"""
