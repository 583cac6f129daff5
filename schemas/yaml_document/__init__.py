"""YAML files that people write, checked with line and column.

`document` reads the text and collects faults. `fault_words` puts pydantic's errors into words. `partial` makes it
possible to check the valid part of a faulty file for further faults.
"""
