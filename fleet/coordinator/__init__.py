"""The coordinator process: it runs the policy, and commands the cars. Read `coordinator` first.

`inbox` has what comes over the bus, `observer` makes a picture of the cars of it, `plan_commands` reads commands.
`open_commands` has the commands that are on their way, `publications` what goes out, `state_file` what outlives the
process. `other_coordinators` sees to it that there is only one.
"""
