"""Brings what the bus says of a fleet to other people's programs, each as a process of its own. No command comes back.

`foxglove_server` serves Foxglove live. `home_assistant` says what Home Assistant reads of a car, pure; `mqtt_bridge`
publishes it to a broker.
"""
