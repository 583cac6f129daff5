"""The `fleet` command as a script and as `python -m fleet`: a Ctrl-C while it is imported is no traceback."""

from schemas.process import startup


def main() -> None:
    """Entry point of the script."""
    startup.begin()
    from fleet.cli import main as run

    run()


if __name__ == "__main__":
    main()
