"""One process per car: the car's bytes become keyed Zenoh publications, and commands become bytes.

Read `car` first: it wires the parts. `link` carries bytes (serial, TCP, Bluetooth LE). `control` decides who may
command the car, and keeps the records. `drivers` has one driver for each family of cars. A driver turns bytes into
readings and actions into frames, stops the car, and says what may be claimed about it. `control.driver` is the
interface between `control` and `drivers`, which are both pure. `bus` publishes and answers. `tools` has the bench
commands, `sim` the simulated cars.
"""
