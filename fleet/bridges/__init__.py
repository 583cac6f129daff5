"""Bridges from the bus to other programs, each in a process of its own.

They publish the state of a fleet, and accept no commands. `foxglove_server` serves Foxglove live. `home_assistant`
decides what Home Assistant gets about a car, and is pure. `mqtt_bridge` publishes that to a broker.
"""
