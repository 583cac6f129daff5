"""Records, reads and converts sessions: directories with MCAP segments. Scripts use `fleet.Session`.

Read `session_dir` first, then the packages `writing`, `reading` and `tools`.
"""
