"""The subcommands of `fleet`: click code and no logic. `fleet.cli` lists them.

They share `options`, `params` and `output`.
"""
