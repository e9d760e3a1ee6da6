"""The command line: ``python -m benchmarks VERB``."""

import signal

if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a batch system ends a job with it
    try:
        from benchmarks.cli import main  # seconds, in which Ctrl-C is no error

        code = main()
    except KeyboardInterrupt:
        code = 130
    raise SystemExit(code)
