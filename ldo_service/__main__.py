"""Entry point of `python -m ldo_service`, the same as `ldo`."""

from ldo_service.commands.cli import main

if __name__ == "__main__":
    main()
