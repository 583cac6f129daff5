"""What all processes of the fleet share: keys, topics, messages and the bus.

Read `keys` and `topics` first, then `messages` (classes of `proto/`, generated into `gen/`) and `bus` (Zenoh).
`process` holds what every process does at its start and end. `gateway run` imports nothing else from outside itself, so
no framework may come in here but where a module says so.
"""
