"""``python -m nlosrender``: the same command line as ``nlosrender``."""

from nlosrender.cli.app import main

if __name__ == "__main__":
    main()
