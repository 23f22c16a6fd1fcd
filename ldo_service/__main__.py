"""`python -m ldo_service` is `ldo`."""

from ldo_service.cli import main

if __name__ == "__main__":
    main()
