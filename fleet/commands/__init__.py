"""The subcommands of `fleet`: click code and no logic. `fleet.cli` lists them.

They share `command_group`, `options`, `exit_code`, `car_names`, `params` and `output`.
"""
