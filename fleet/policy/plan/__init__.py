"""A plan: its values, its file format, the parser, and the checks before it runs. Pure."""
