"""Control of one car of any family. Pure: time is an argument.

Read `controller` first: it handles commands. `refusals` and `safety_state` decide which sender may command the car.
`command_queue` holds the commands that wait for the car, `command_records` their records. `driver` defines what the
driver of a family must do.
"""
