"""`python -m pneuopt`."""

from pneuopt.cli.app import main

if __name__ == "__main__":
    main()
