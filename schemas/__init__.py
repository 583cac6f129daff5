"""Parts that all processes of the fleet share: keys, topics, messages and the bus.

Read `words` first: the closed sets of words. Then read `keys`, `topics` and `commands`, and at last `messages`
(classes of `proto/`, generated into `gen/`) and `bus`. `process` contains the common parts of the start and the end of
a process. `gateway run` imports no other package of ours, so a module here that imports a framework says so.
"""
