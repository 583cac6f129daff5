"""A plan: its values, its file format, and the parser. Pure."""
