"""Control of one car of any family. Pure: time is an argument.

Read `controller` first: it takes commands. `arbiter` and `safety` decide which sender may command, `command_queue`
holds what waits for the car, `command_log` the records. `driver` is what the driver of a family must say and do.
"""
