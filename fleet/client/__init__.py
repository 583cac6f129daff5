"""The SDK: `Fleet` and `Car`, which command cars and read their messages.

Read `client` first. `commands` makes requests, `command_tracker` follows them until each car's `outcome` is known.
`car_state` is the state of a car as all its messages show it, and `claims` puts that into words.
`reading`, `history_query` and `key_survey` read the bus, `wait` waits for a condition, `lease` reserves a car.
"""
