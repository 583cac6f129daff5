"""The `fleet` command as a script and as `python -m fleet`.

Ctrl-C prints no traceback, even while the command starts or ends.
"""

from schemas.process import startup


def main() -> None:
    """Entry point of the script."""
    startup.end_at_ctrl_c()
    from fleet.cli import main as run

    try:
        run()
    finally:
        startup.end_at_ctrl_c()


if __name__ == "__main__":
    main()
