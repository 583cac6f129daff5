"""The fleet file: `models`, reading (`fleet_file`), edits (`editor`), new ones (`template`), `scan`, `link_check`."""
