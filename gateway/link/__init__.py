"""Byte streams to a car: serial, TCP. Bytes only."""
