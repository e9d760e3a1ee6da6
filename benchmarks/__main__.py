"""The command line: ``python -m benchmarks [run|plan|tables|...]``; alone, ``run`` with ``quick``.

Exit codes: 0 done, 1 a run failed or a check found a difference, 2 bad input, 130 interrupted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks import commands
from benchmarks.errors import BenchmarkError
from benchmarks.presets import DEFAULT_PRESET, preset_names

Command = Callable[[argparse.Namespace], int]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or (words[0].startswith("-") and words[0] not in ("-h", "--help")):
        words = ["run", *words]
    if words[0] in commands.DELEGATED and words[1:2] != ["--help"]:
        return _guarded(lambda: commands.delegate(words[0], words[1:]))
    parser = _parser()
    arguments = parser.parse_args(words)
    command: Command = arguments.command
    return _guarded(lambda: command(arguments))


def _guarded(action: Callable[[], int]) -> int:
    try:
        return action()
    except BenchmarkError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument(
        "--preset",
        default=DEFAULT_PRESET,
        help=f"{', '.join(preset_names())}, or a .yaml file (default: {DEFAULT_PRESET})",
    )
    common.add_argument("--results", type=Path, default=Path("results"), help="results folder")
    jobs = argparse.ArgumentParser(add_help=False)
    jobs.add_argument("--jobs", type=_positive, default=None, help="processes (default: cores)")
    verbs = parser.add_subparsers(required=True, metavar="command")

    def add(name: str, command: Command, text: str, *more: argparse.ArgumentParser) -> None:
        verb = verbs.add_parser(name, help=text, description=text, parents=[common, *more])
        verb.set_defaults(command=command)

    one = argparse.ArgumentParser(add_help=False)
    one.add_argument("--cell", required=True, help="a cell's id, as `plan` lists them")
    one.add_argument("--parent", type=int, default=None, help=argparse.SUPPRESS)
    model = argparse.ArgumentParser(add_help=False)
    model.add_argument("--model", type=Path, default=None, help="a .zip saved by an SB3 algorithm")
    model.add_argument("--algorithm", default="rainbow", help="its class: rainbow, dqn, ppo, ...")
    model.add_argument("--episodes", type=_positive, default=None, help="test episodes per seed")
    page = argparse.ArgumentParser(add_help=False)
    page.add_argument("--readme", type=Path, default=Path("README.md"), help="the file")

    add("run", commands.run, "train, plan and test what is missing, then the tables", jobs)
    add("plan", commands.plan, "list the cells of a preset and their state")
    add("train", commands.train, "run one cell in this process", one)
    add("evaluate", commands.evaluate, "score stored policies, or --model, on the tests", model)
    add("tables", commands.tables, "write and print the tables from stored data")
    add("figures", commands.figures, "draw the learning figures from stored data")
    add("curves", commands.curves, "say where the training curves of each run stand")
    add("verify", commands.verify, "check tables and README against stored episodes", page)
    add("readme", commands.readme, "rewrite the results section of the README", page)
    verbs.add_parser("speed", help="measure speed: speed env, speed rainbow")
    verbs.add_parser("design", help="the geometric optimization: table and figures")
    return parser


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{number} is below 1")
    return number


if __name__ == "__main__":
    raise SystemExit(main())
