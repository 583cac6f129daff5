"""Parts that all processes of the fleet share: keys, topics, messages and the bus.

Read `words` first: the closed sets of words. Then read `keys`, `topics` and `commands`, and at last `messages` (classes
of `proto/`, generated into `gen/`) and `bus`. `process` contains the common parts of the start and the end of a
process. A module whose docstring says "Pure" does no I/O, and gets the time as an argument.

Of our packages, `gateway run` imports only `gateway` and `schemas`. It imports no framework, so that many gateways fit
on one machine. Only `yaml_document`, `world_fields` and `world_check` use one (pydantic), and `gateway run` does not
import them.
"""
