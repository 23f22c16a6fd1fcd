"""`python -m ldo_service` is `ldo`."""

from ldo_service.commands.cli import main

if __name__ == "__main__":
    main()
