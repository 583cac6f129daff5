"""The SDK: `Fleet` and `Car`, which command cars and read their messages.

Read `client` first. `commands` makes requests, `command_tracker` follows them until each car's `outcome` is known.
`reading`, `history` and `key_survey` read the bus, `wait` waits for a condition, `lease` reserves a car.
"""
