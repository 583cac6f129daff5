"""One process per car: the car's bytes become keyed Zenoh publications, and commands become bytes.

Read `car_gateway` first: it wires the parts. `link` carries bytes (serial, TCP, Bluetooth LE). `control` decides who
may command the car, and keeps the records. `drivers` has one driver for each family of cars. A driver turns bytes into
readings and actions into frames, stops the car, and says what may be claimed about the car, such as that it stands
still. `control.driver` is the interface between `control` and `drivers`. These two packages are pure: they do no I/O,
and get the time as an argument. `bus` publishes and answers. `tools` has the commands for tests at the desk, and `sim`
the simulated cars.
"""
