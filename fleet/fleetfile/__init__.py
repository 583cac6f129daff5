"""The fleet file: `models`, reading (`fleet_file`), edits (`editor`), a first file from a `scan`, and `link_check`."""
