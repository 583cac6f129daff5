"""Control of one car. Pure: time is an argument.

Read `controller` first. It takes commands, and holds four objects. `car_model` has the estimates of the car. `executor`
sends frames, and `stop_executor` carries out stops. `car_monitor` handles readings and silence. `arbiter` and `safety`
decide which sender may command. The packages `estimate` and `stops` have the parts of the model and of a stop.
"""
