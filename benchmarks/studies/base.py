"""What a study is: parts, each measured once, and the texts, tables and pages made of them.

A study is data on :class:`Study`: options, parts, tables, a page. The base resumes, shows the bar,
stores, publishes and verifies.
"""

import argparse
import hashlib
import importlib
import inspect
import json
import shlex
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Final

import pandas as pd
from rich.console import Console

from benchmarks.errors import BenchmarkError, at_least
from benchmarks.protocol.presets import read_yaml
from benchmarks.reporting import blocks
from benchmarks.reporting.blocks import Block
from benchmarks.reporting.verify import check_file
from benchmarks.runs.harness import bar
from benchmarks.runs.machine import describe
from benchmarks.runs.store import write_text
from coop_env.geometry import RRSGeometry

Tick = Callable[[float], None]  # called with the share that is done, 0 to 1
Part = Callable[[Tick], Any]
Option = Mapping[str, Any]  # keyword arguments of add_argument
Act = Callable[[Any, Any], Any]  # an action from an observation and the action masks


class Study(ABC):
    """A study. ``given`` has the values of its options, ``results``, and the ``command`` line.

    Attributes:
        name: of the command, of its folder below the results folder, and of its block.
        options: argparse's arguments by name.
        needs: modules that an extra brings, and the extra.
    """

    name: ClassVar[str] = ""
    options: ClassVar[Mapping[str, Option]] = {}
    needs: ClassVar[tuple[str, ...]] = ()

    def __init__(self, given: argparse.Namespace) -> None:
        if not self.name:
            raise BenchmarkError(f"{type(self).__name__} needs name, the name of the study")
        self.given, self.results = given, Path(given.results)
        self.folder = self.results / self.name

    @classmethod
    def command_name(cls) -> str:
        """Its name on the command line: ``module:Class`` if it is not in the catalogue."""
        here = cls.__module__.startswith("benchmarks.")
        return cls.name if here else f"{cls.__module__}:{cls.__name__}"

    @classmethod
    def parser(cls) -> argparse.ArgumentParser:
        """The command line of the study."""
        result = argparse.ArgumentParser(
            prog=f"python -m benchmarks study {cls.command_name()}",
            description=importlib.import_module(cls.__module__).__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        result.add_argument("--results", type=Path, default=Path("results"), help="results folder")
        for name, arguments in cls.options.items():
            result.add_argument(name, **arguments)
        return result

    @classmethod
    def main(cls, argv: Sequence[str]) -> int:
        """Measure what is missing, then tables, figures and pages; returns the exit code."""
        given = cls.parser().parse_args(list(argv))
        given.command = shlex.join(
            ["python", "-m", "benchmarks", "study", cls.command_name(), *argv]
        )
        for module in cls.needs[:-1]:
            try:
                importlib.import_module(module)
            except ImportError as error:
                message = (
                    f"{cls.name} needs pip install 'sb3-rainbow-coop[{cls.needs[-1]}]': {error}"
                )
                raise BenchmarkError(message) from error
        console = Console(soft_wrap=True, markup=False)
        study = cls(given)
        with bar(console) as progress:
            for name, part in study.parts().items():
                task = progress.add_task(name, total=1.0)
                study.keep(name, part(lambda share, t=task: progress.update(t, completed=share)))  # type: ignore[misc]
                progress.update(task, completed=1.0)
        study.finish()
        for path, text in cls.files(study.results).items():
            write_text(path, text)
            if path.is_relative_to(study.folder):  # not what it wrote to another store
                console.print(text, highlight=False)
        pages = blocks.rewrite(study.results, cls.blocks(study.results))
        console.print(f"Written to {', '.join(map(str, [study.folder, *pages]))}")
        return 0

    @abstractmethod
    def parts(self) -> Mapping[str, Part]:
        """What is still to be measured, by name, in order."""

    def keep(self, name: str, result: Any) -> None:  # noqa: B027 - a part may store its own
        """Store the result of a part."""

    def finish(self) -> None:  # noqa: B027 - few draw
        """Write what needs all parts: figures, or other files."""

    @classmethod
    def files(cls, results: Path) -> dict[Path, str]:
        """Files that follow from what is stored, with their texts; none where nothing is."""
        return {}

    @classmethod
    def blocks(cls, results: Path) -> dict[str, Block]:
        """Blocks of pages that follow from what is stored: by default the text of its file."""

        def block(_: str) -> str:
            if not (texts := list(cls.files(results).values())):
                raise KeyError(cls.name)
            return "\n\n".join(texts)

        return {cls.name: block}

    @classmethod
    def problems(cls, results: Path) -> list[str]:
        """A sentence for each stored thing that disagrees with what it follows from."""
        return [
            problem
            for path, text in cls.files(results).items()
            for problem in check_file(path, text, f"the data in {path.parent}")
        ]


class OfOneFile(Study):
    """A study whose texts all follow from one JSON ``file`` below the results folder."""

    file: ClassVar[str] = ""

    @staticmethod
    @abstractmethod
    def to_markdown(result: Any) -> str:
        """What the file holds, as Markdown."""

    @classmethod
    def files(cls, results: Path) -> dict[Path, str]:
        path = results / cls.file
        if not path.is_file():
            return {}
        return {path.with_suffix(".md"): cls.to_markdown(read_stored(path)).strip() + "\n"}


class Measured(OfOneFile):
    """A study whose parts lie in one JSON file, each stored as soon as it is done.

    Other settings or another commit begin a new file, and the old one is kept beside it.
    """

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        if not self.file:
            raise BenchmarkError(f"{type(self).__name__} needs file, its JSON below the results")
        self.path = self.results / self.file
        self.folder = self.path.parent
        self.result: dict[str, Any] = {"asked": json.loads(_as_json(self.asked())), "parts": {}}
        self._others = self.path.is_file()  # the file holds other settings
        if self._others:
            stored = read_stored(self.path)
            if not isinstance(stored, dict) or not isinstance(stored.get("parts"), dict):
                raise BenchmarkError(f"{self.path} holds no study's parts; move it away")
            if stored.get("asked") == self.result["asked"]:
                self.result, self._others = stored, False
        self.result |= {"command": given.command, "machine": describe()}

    def asked(self) -> dict[str, Any]:
        """The settings that decide the parts, as JSON can hold them."""
        given = {k: v for k, v in vars(self.given).items() if k not in ("results", "command")}
        ours = type(self).__module__.startswith("benchmarks.")  # its commit is recorded
        edited = {} if ours else source_digest(type(self))
        return {**given, "commit": describe()["commit"], **edited}

    @abstractmethod
    def measures(self) -> Mapping[str, Part]:
        """All parts, by name, in order."""

    def parts(self) -> Mapping[str, Part]:
        kept = self.result["parts"]
        return {str(name): part for name, part in self.measures().items() if str(name) not in kept}

    def keep(self, name: str, result: Any) -> None:
        self.result["parts"][name] = result
        text = _as_json(self.result) + "\n"
        if self._others:
            kept, self._others = self.path.with_suffix(".before.json"), False
            while kept.exists():
                kept = kept.with_suffix(".before.json")
            self.path.replace(kept)
            print(f"{self.path} was measured with other settings or at another commit: see {kept}")
        write_text(self.path, text)

    @classmethod
    def problems(cls, results: Path) -> list[str]:
        try:
            return super().problems(results)
        except KeyError as missing:
            return [f"{results / cls.file} has no {missing}: the command of the study goes on"]


def source_digest(of: Any) -> dict[str, str]:
    """The digest of the source file of a user's own class or function, which changes with edits."""
    try:
        source = Path(str(inspect.getsourcefile(of)))
        return {"source_sha256": hashlib.sha256(source.read_bytes()).hexdigest()}
    except (OSError, TypeError):  # made in memory
        return {}


def _as_json(value: Any) -> str:
    """JSON, with numpy's numbers and arrays as numbers and lists and paths as text."""

    def plain(each: Any) -> Any:
        return each.tolist() if hasattr(each, "tolist") else str(each)

    return json.dumps(value, indent=1, default=plain)


def read_stored(path: Path) -> Any:
    """What a JSON or CSV file holds; BenchmarkError if it is missing or damaged."""
    try:
        if path.suffix == ".csv":
            return pd.read_csv(path)
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BenchmarkError(f"{path} cannot be read ({error}); delete it") from error


def count(default: int | None, what: str, least: int = 1) -> Option:
    """An option that is a whole number."""
    return {"type": at_least(least), "default": default, "help": what}


def episode(env: Any, act: Callable[[Any], Any], **reset: Any) -> Iterator[dict[str, Any]]:
    """Play an episode; yields the ``info`` of its reset, with these arguments, and of each step.

    It ends with the environment's, or where ``act`` has no action after an observation.
    """
    observation, info = env.reset(**reset)
    yield info
    over = False
    while not over and (action := act(observation)) is not None:
        observation, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        yield info


def by_plans(env: Any, plan: Callable[[Any], Any]) -> Callable[..., Any]:
    """Moves of plans, one for each hole, run open loop; None once a plan fails to fill its hole."""

    def moves() -> Iterator[int]:
        filled = -1
        while env.running and (done := int(env.state["filled"].sum())) > filled:
            filled, plan_moves = done, plan(env).moves
            yield from () if plan_moves is None else map(int, plan_moves)

    result = moves()
    return lambda *_: next(result, None)


def greedy(model: Any) -> Act:
    """A model's greedy action for one observation."""
    from benchmarks.evaluation.evaluate import model_policy

    act = model_policy(model)
    return lambda observation, masks: int(act(observation[None], masks[None])[0])


#: fields of a track that decide a policy's view of the nominal task
SEEN: Final = (
    "observation",
    "mask_singularities",
    "mask_visited",
    "mask_refused",
    "task",
    "shield",
)


def stored_player(path: Path, trust: bool = False) -> tuple[dict[str, Any], Act]:
    """The arguments of the environment that a model was trained in, and its greedy actions.

    A run's policy has its ``config.yaml`` beside it. BenchmarkError if the file is missing, is no
    model, or is not of the single-agent task.
    """
    from benchmarks.evaluation.model_files import fitting_observation, load_model

    model = load_model(path, trust=trust)
    arguments: dict[str, Any] = {"observation": fitting_observation(model, path)}
    config = path.with_name("config.yaml")
    if path.name == "policy.zip" and config.is_file():  # a run's, which load_model has checked
        result = read_yaml(config)
        track = result["track"].items()  # None is what the environment has by default
        arguments |= {name: value for name, value in track if name in SEEN and value is not None}
        own = result.get("dimensions")
        arguments["geometry"] = RRSGeometry(**own) if own else result["cell"]["geometry"]
    return arguments, greedy(model)


def source(result: Mapping[str, Any], more: str = "") -> str:
    """Where measurements come from: command, machine, commit."""
    machine = result["machine"]
    return (
        f"Command: `{result['command']}`. {machine['machine']['processor']}, "
        f"commit {machine['commit'][:9]}{more}."
    )
