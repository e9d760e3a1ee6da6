"""The command line: ``python -m benchmarks VERB``."""

if __name__ == "__main__":
    try:
        from benchmarks.cli import main  # takes seconds, in which Ctrl-C is no error

        code = main()
    except KeyboardInterrupt:
        code = 130
    raise SystemExit(code)
