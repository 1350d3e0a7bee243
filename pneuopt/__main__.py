"""`python -m pneuopt`."""

from pneuopt.cli import main

if __name__ == "__main__":
    main()
