"""The SDK: `Fleet` and `Car`, which command cars and read their messages.

Read `client` first. `commands` makes requests, `command_tracker` follows them until each car's `outcome` is known.
`car_state` is a car as all its messages show it, and `claims` has the words for that.
`reading`, `history` and `key_survey` read the bus, `wait` waits for a condition, `lease` reserves a car.
"""
