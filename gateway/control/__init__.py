"""Control of one car, pure: what is sent when, and what is believed of the car. Time comes in as an argument.

Read `controller` first: it holds `car_model` (what is believed), `executor` (frames, stops, renewals) and `car_monitor`
(readings and silence). `arbiter` and `safety` decide who may command. `estimate` and `stops` have the parts of the
model and of a stop.
"""
