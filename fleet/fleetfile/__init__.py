"""The fleet file: models (`fleet_model`), reading (`fleet_file`), edits (`editor`), new files (`template`).

`scan_process` finds links, `link_check` and `adapter_check` check them.
"""
