"""The driver of the cars that speak the `$...#` protocol: arduino, stm32, raspberry_pi. Pure.

`driver` joins the parts. `protocol` turns bytes into events and frames into bytes. `car_model` has the estimates of the
car, with the parts in `estimate`. `executor` sends frames, and `stop_executor` carries out stops, with the parts in
`stops`. `car_monitor` handles readings and silence.
"""
