"""The command ``dsr``, which is ``python -m dsr``."""

from typing import NoReturn

from dsr.utils.interruption import start


def main() -> NoReturn:
    """Run the command with the arguments of the process, and end it."""
    start("dsr.cli", "main")


if __name__ == "__main__":
    main()
