"""One process per car: the car's bytes become keyed Zenoh publications, and commands become bytes.

Read `car` first: it wires the parts. `link` carries bytes (serial, TCP, Bluetooth LE). `control` decides who may
command the car and keeps the records. `drivers` has one driver for each family of cars: it turns bytes into readings
and actions into frames, stops the car, and says what may be claimed of it. `control.driver` is the seam between them.
`bus` publishes and answers. `tools` are the bench commands, `sim` the simulated cars. `control` and `drivers` are pure.
"""
