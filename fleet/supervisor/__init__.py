"""`fleet up`: starts all processes of a fleet, restarts crashed processes, and stops every car before it exits.

Read `supervisor` first. `spec` describes the fleet to run, `processes` and `child` run its processes. `process_state`,
`start_limit` and `hang` decide when to start, restart or kill a process (pure). `shutdown` shuts down the gateways in
order. `start_report` says what a start has found, `log_files` has the lines of all processes. `supervisor_service`
answers queries on the bus, `status_table` draws the table.
"""
