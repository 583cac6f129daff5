"""The coordinator process: it runs the policy, and commands the cars. Read `coordinator` first.

`inbox` holds the input from the bus, `observer` turns it into snapshots of the cars, `plan_query_parser` reads
commands. `open_commands` holds the commands without an outcome yet, `publications` the output, `plan_state_file` the
state that outlives the process. `other_coordinators` ensures that there is only one coordinator.
"""
