"""One process per car: the car's bytes become keyed Zenoh publications, and commands become bytes.

Read `car` first: it wires the four parts. `link` carries bytes (serial, TCP, Bluetooth LE), `protocol` turns bytes into
events and commands into frames, `control` decides what is sent when and what is believed of the car, `bus` publishes
and answers. `tools` are the bench commands, `sim` the simulated cars. `protocol` and `control` are pure.
"""
