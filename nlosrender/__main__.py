"""The ``nlosrender`` command, and ``python -m nlosrender``."""

from nlosrender.cli.early_interrupt import leave_on_interrupt


def main() -> None:
    """Run the command line; Ctrl-C is heard before the first import that takes time."""
    leave_on_interrupt()
    from nlosrender.cli.app import main as run

    run()


if __name__ == "__main__":
    main()
