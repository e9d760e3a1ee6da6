"""The command line: ``python -m benchmarks VERB``."""

from benchmarks.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
