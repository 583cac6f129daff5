"""YAML files that people write, checked with line and column.

`document` reads the text and collects faults, `messages` puts pydantic's errors into words, `partial` lets the sound
rest of a faulty file be checked too.
"""
