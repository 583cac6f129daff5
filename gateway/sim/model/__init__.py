"""The simulated cars' pure core: programs on virtual time, and the world. No I/O, no clock; random numbers come in.

`firmware_base` is the base of the programs `arduino`, `stm32`, `raspberry_pi` and `course`, `traits` has their
parameters, `mode_car` the modes. `ugv` has the programs of another family. `car_body` puts a car into the `world` with
its `objects`. `faulty_link` carries the bytes, `capture_car` plays a capture, `scheduler` runs, in the order of time,
the programs of the cars in a lively world.
"""
