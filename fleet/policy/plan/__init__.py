"""A plan: its values, its file format, the parser, and the lint that checks it before it runs. Pure."""
