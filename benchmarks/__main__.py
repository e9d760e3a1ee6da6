"""The command line: ``python -m benchmarks [run|plan|tables|...]``; alone, ``run`` with ``quick``.

Exit codes: 0 done, 1 a run failed or a check found a difference, 2 bad input, 130 interrupted.
"""

from __future__ import annotations

import argparse
import errno
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks import commands
from benchmarks.errors import BenchmarkError, at_least
from benchmarks.protocol.presets import DEFAULT_PRESET, preset_names
from benchmarks.runs.backends import BACKENDS

Command = Callable[[argparse.Namespace], int]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or (words[0].startswith("-") and words[0] not in ("-h", "--help")):
        words = ["run", *words]
    # speed alone has no parser of its own before its second word
    if words[0] in commands.DELEGATED and words[:2] != ["speed", "--help"]:
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
    except (NotADirectoryError, FileExistsError, PermissionError) as error:
        if error.filename is None:
            raise
        print(f"error: {error.strerror}: {error.filename}; name another place", file=sys.stderr)
        return 2
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        print(
            f"error: {error.strerror}: {error.filename or 'the results folder'}; make room, the "
            "same command goes on",
            file=sys.stderr,
        )
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
    device = argparse.ArgumentParser(add_help=False)
    device.add_argument(
        "--device", choices=("cpu", "cuda"), help="of the networks (default: cpu, with GPUs cuda)"
    )
    jobs = argparse.ArgumentParser(add_help=False)
    jobs.add_argument("--jobs", type=at_least(1), default=None, help="processes (default: cores)")
    place = argparse.ArgumentParser(add_help=False)
    place.add_argument(
        "--backend", choices=BACKENDS, default=BACKENDS[0], help="processes here, or a Ray cluster"
    )
    place.add_argument("--address", help="of the Ray cluster, 'auto' for the one at hand")
    place.add_argument(
        "--gpus-per-run", type=float, default=0.0, help="GPUs, or part of one, for each run (Ray)"
    )
    verbs = parser.add_subparsers(required=True, metavar="command")

    def add(name: str, command: Command, text: str, *more: argparse.ArgumentParser) -> None:
        verb = verbs.add_parser(name, help=text, description=text, parents=[common, *more])
        verb.set_defaults(command=command, study="insertion")

    one = argparse.ArgumentParser(add_help=False)
    one.add_argument("--cell", required=True, help="a cell's id, as `plan` lists them")
    one.add_argument("--parent", type=int, default=None, help=argparse.SUPPRESS)  # the harness
    one.add_argument(
        "--wait", type=float, default=0.0, help="seconds to wait for another process on the cell"
    )
    model = argparse.ArgumentParser(add_help=False)
    _add_entry(model)
    page = argparse.ArgumentParser(add_help=False)
    page.add_argument("--readme", type=Path, default=Path("README.md"), help="the file")

    what = "train, plan and test what is missing, then the tables"
    add("run", commands.run, what, jobs, device, place)
    add("plan", commands.plan, "list the cells of a preset, their state and cost", jobs)
    add("train", commands.train, "run one cell in this process", one, device)
    text = "score a --model or --planner of your own for the leaderboard, or stored policies again"
    add("evaluate", commands.evaluate, text, model)
    add("tables", commands.tables, "write and print the tables from stored data")
    add("figures", commands.figures, "draw the learning figures from stored data")
    add("report", commands.report, "tables and figures from stored data")
    _add_verify(verbs, page)
    _add_readme(verbs, page)
    verbs.add_parser("speed", help="measure speed: speed env, speed rainbow")
    verbs.add_parser("media", help="draw a picture, a video and an animation of one episode")
    verbs.add_parser("watch", help="the optimum or a policy plays in the browser")
    verbs.add_parser("design", help="the geometric optimization: table and figures")
    verbs.add_parser("codesign", help="the 3-RRS chosen together with the policy")
    verbs.add_parser("audit", help="what each reward pays for: scripts and learners")
    verbs.add_parser("failures", help="where stored policies fail, and why")
    verbs.add_parser("physics", help="the physics twin: errors, speed, model folder")
    verbs.add_parser("contact", help="scripts on the contact task: success, time, force")
    verbs.add_parser("shield", help="the shield: certificate, adversary, price")
    verbs.add_parser("transfer", help="the kinematic task's players on the simulated machine")
    verbs.add_parser("data", help="Minari datasets of the task, for learners without an env")
    _add_classic(verbs)
    hidden = verbs.add_parser("cell", parents=[one, device])
    for name in ("experiment", "recipe"):
        hidden.add_argument(name)
    hidden.add_argument("store", type=Path)
    hidden.set_defaults(command=commands.cell)
    return parser


def _add_classic(verbs: Any) -> None:
    from benchmarks.studies.classic import presets

    text = "Rainbow beside DQN and QR-DQN on small tasks"
    epilog = "; ".join(f"{word}: {what}" for word, what in commands.CLASSIC.items())
    verb = verbs.add_parser("classic", help=text, description=text, epilog=epilog)
    add = verb.add_argument
    add("word", nargs="?", default="run", choices=commands.CLASSIC, help="default: run")
    names = ", ".join(presets.preset_names())
    add("--preset", default=presets.DEFAULT_PRESET,
        help=f"{names}, or a .yaml file (default: {presets.DEFAULT_PRESET})")  # fmt: skip
    add("--results", type=Path, default=Path("results"), help="results folder")
    add("--workers", "--jobs", dest="jobs", type=at_least(1), default=None,
        help="processes (default: cores)")  # fmt: skip
    add("--page", type=Path, default=None,
        help="of docs: the file (default: that of docs/ with the preset's block)")  # fmt: skip
    add("--cell", default=None, help="of train: the run's id, as plan lists them")
    add("--wait", type=float, default=0.0, help=argparse.SUPPRESS)
    add("--parent", type=int, default=None, help=argparse.SUPPRESS)
    verb.set_defaults(command=commands.classic, study="classic", backend="local", address=None,
        gpus_per_run=0.0, device=None)  # fmt: skip


def _add_entry(model: argparse.ArgumentParser) -> None:
    add = model.add_argument
    add(
        "--model",
        type=Path,
        nargs="+",
        metavar="FILE",
        default=[],
        help=".zip of any SB3 or sb3-contrib algorithm: one, or one per seed",
    )
    add(
        "--planner",
        default="",
        metavar="NAME",
        help="a planner: rrt_connect, rrt_lattice, optimum, or module:function of your own",
    )
    add("--name", default=None, help="on the leaderboard (default: the file's name)")
    add("--algorithm", "--algo", default=None, help="the model's class (default: found out)")
    add("--trust", action="store_true",
        help="load a --model that SB3 saved, which runs its author's code")  # fmt: skip
    add("--mask-singularities", action="store_true", help="as the model was trained")
    add("--mask-visited", type=int, default=0, metavar="N", help="as the model was trained")
    add("--replace", action="store_true", help="take the place of another entry of this name")
    add("--episodes", type=at_least(1), default=None,
        help="test episodes per seed, for a quick look: nothing joins the leaderboard")  # fmt: skip
    add(
        "--starts",
        type=at_least(0),
        default=None,
        metavar="NUMBER",
        help="stored policies: begin where this number says, not at the test episodes' starts; 20 "
        "episodes per seed unless --episodes says else, at the headline's levels alone",
    )


def _add_readme(verbs: Any, page: argparse.ArgumentParser) -> None:
    text = "rewrite the results section of the README, and the tables in the docs beside it"
    verb = verbs.add_parser("readme", help=text, description=text, parents=[page])
    verb.add_argument("--preset", default=None, help="(default: the one that the README shows)")
    verb.add_argument("--results", type=Path, default=Path("results"), help="results folder")
    verb.set_defaults(command=commands.readme, study="insertion")


def _add_verify(verbs: Any, page: argparse.ArgumentParser) -> None:
    text = "check tables, README and docs against the stored data of every preset"
    verb = verbs.add_parser("verify", help=text, description=text, parents=[page])
    verb.add_argument("--preset", default=None, help="one preset (default: all with results)")
    verb.add_argument("--results", type=Path, default=Path("results"), help="results folder")
    verb.add_argument("--docs", type=Path, default=Path("docs"), help="folder of the docs")
    verb.set_defaults(command=commands.verify)


if __name__ == "__main__":
    raise SystemExit(main())
