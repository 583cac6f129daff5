"""The generated pages and parts of docs/. `python -m tests.tools.pages` writes them.

`build` has the table of parts and pages, `tables` the tables of protocol and topics, `command_line` the pages of the
commands, `files` the fields of fleet files, plans and worlds, `proto` those of messages, `python_api` the Python names.
"""
