"""The command `approxjac`, as a program and as `python -m approxjac`."""

import sys


def main() -> int:
    """Run the command line; returns the exit code, also where Ctrl-C comes during an import."""
    try:
        from approxjac import cli

        return cli.main()
    except KeyboardInterrupt:
        print("\napproxjac: stopped", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
