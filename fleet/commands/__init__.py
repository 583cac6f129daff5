"""The subcommands of `fleet`: click code and no logic. `fleet.cli` lists them.

They share `command_group`, `options`, `car_names`, `params` and `output`.
"""
