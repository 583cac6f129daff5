"""Control of one car of any family. Pure: time is an argument.

Read `controller` first: it takes commands. `refusals` and `holds_and_leases` decide which sender may command,
`command_queue` holds what waits for the car, `command_log` the records. `driver` is what the driver of a family must
say and do.
"""
