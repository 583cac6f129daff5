"""Parts that all processes of the fleet share: keys, topics, messages and the bus.

Read `words` first: the closed sets of words. Then read `keys`, `topics` and `commands`, and at last `messages` (classes
of `proto/`, generated into `gen/`) and `bus`. `process` contains the common parts of the start and the end of a
process. Of our packages, `gateway run` imports only `gateway` and `schemas`, and it imports no framework. So each
module here that does import a framework says so in its docstring.
"""
