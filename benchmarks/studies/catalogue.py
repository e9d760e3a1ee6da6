"""All studies and experiments by name; verification and pages over all of them."""

from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Final

from benchmarks.errors import BenchmarkError, known, resolve
from benchmarks.protocol.presets import SuitePreset, load, preset_names
from benchmarks.reporting import blocks, science
from benchmarks.reporting.blocks import Block
from benchmarks.reporting.results import Results
from benchmarks.reporting.verify import check_tables
from benchmarks.runs.experiment import Experiment
from benchmarks.runs.store import Store, write_text
from benchmarks.studies.base import OfOneFile, Study

#: name -> where it is, and a line of help
STUDIES: Final = {
    "audit": ("audit:Audit", "returns of scripts and learners under each reward"),
    "codesign": ("codesign:Codesign", "a 3-RRS chosen together with the policy"),
    "contact": ("robots.contact:Contact", "scripts on the contact task: success, time, force"),
    "data": ("data:Data", "Minari datasets of the task"),
    "design": ("design.study:Design", "the geometric optimization: tables, figures"),
    "failures": ("failures:Failures", "causes of the failures of stored policies"),
    "media": ("media:Media", "pictures of one episode"),
    "physics": ("robots.physics:Physics", "the physics twin: errors, speed, model folder"),
    "shield": ("robots.shield:Shield", "certificate, adversary and price of the shield"),
    "speed-env": ("speed:SpeedEnv", "steps per second, the optimum"),
    "speed-rainbow": ("speed:SpeedRainbow", "updates per second"),
    "trajectory": ("trajectory:TrajectoryStudy", "joint trajectories, and files of one episode"),
    "transfer": ("robots.transfer:Transfer", "players of the kinematic task in the twin"),
}


def study(name: str) -> type[Study]:
    """The study of that name, or of ``module:Class``; BenchmarkError if there is none."""
    if name in STUDIES:
        name = f"benchmarks.studies.{STUDIES[name][0]}"
    elif ":" not in name:
        raise BenchmarkError(f"unknown study '{name}'; known: {known(STUDIES)}, or module:Class")
    result = resolve(name, "study")
    if not (isinstance(result, type) and issubclass(result, Study)):
        raise BenchmarkError(f"study '{name}' is no subclass of benchmarks.studies.base.Study")
    return result


def write_studies(results: Path) -> None:
    """Write the files of all studies anew from what is stored."""
    for name in STUDIES:
        for path, text in study(name).files(results).items():
            write_text(path, text)


def experiment(preset: str) -> Experiment:
    """The experiment of a preset, by its name or the path of its file."""
    loaded = load(preset)
    if isinstance(loaded, SuitePreset):
        from benchmarks.studies.classic.experiment import Classic

        return Classic(preset)
    from benchmarks.studies.insertion import Insertion

    return Insertion(preset)


def stores(results: Path) -> dict[str, Path]:
    """The presets of this package that have a store, and its folder."""
    return {
        name: path
        for name in preset_names()
        for path in (results / name, results / "classic" / name)
        if (path / "store.json").is_file()
        and isinstance(load(name), SuitePreset) == (path.parent != results)
    }


def others(results: Path) -> list[Path]:
    """The stores of presets of one's own."""
    markers = [*results.glob("*/store.json"), *results.glob("classic/*/store.json")]
    return sorted({marker.parent for marker in markers} - {*stores(results).values()})


def all_blocks(results: Path) -> Mapping[str, Block]:
    """Every block that a page may hold."""
    from coop_env import CoopInsertionEnv

    def of_store(name: str) -> Store:
        folder = results.joinpath(*Path(name).parts[1:])
        if not (folder / "store.json").is_file():
            raise KeyError(name)
        return Store.open(folder.parent, folder.name)

    @cache
    def results_of(name: str) -> Results:
        return Results(of_store(name))

    def public(argument: str) -> str:
        from benchmarks.studies.classic.report import page

        return page(of_store(argument))

    result: dict[str, Block] = {
        "include": blocks.include(results),
        "docstring": blocks.docstring(CoopInsertionEnv),
        "results": lambda argument: science.short(results_of(argument)),
        "science": lambda argument: science.science(
            results_of(argument.split()[0]), "beyond" in argument
        ),
        "classic": public,
    }
    for name in STUDIES:
        result |= study(name).blocks(results)
    return result


def _of_store(one: Experiment, results: Path) -> list[str]:
    store = one.open_store(results)
    # rows that cannot be trusted make no tables
    return one.problems(store) or check_tables(store.tables, one.tables(store))


def named(path: Path, check: Callable[[], list[str]]) -> list[str]:
    """What ``check`` finds below ``path``; an error that it raises becomes a sentence too."""
    try:
        return check()
    except BenchmarkError as error:  # a damaged file ends its check, the others go on
        return [str(error)]
    except Exception as error:  # a damaged file may raise anything
        return [f"{path}: a file cannot be read ({type(error).__name__}: {error})"]


def verify(results: Path, presets: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Check the stores of ``presets`` (all under ``results`` if none is named), studies and pages.

    Yields what is checked, then a sentence for each difference.
    BenchmarkError if there are no results, or none of one of ``presets``.
    """
    there, differs = stores(results), False
    if not (there or presets or others(results)):
        raise BenchmarkError(f"{results} has no results; run: python -m benchmarks run")
    checks: list[tuple[str, Path, Callable[[], list[str]]]] = []
    for name in presets or there:
        one = experiment(name)
        if presets:
            one.open_store(results)
        folder = results / one.place / one.name
        runs = Store(folder.parent, folder.name).completed()
        policies = sum(run.policy.is_file() for run in runs)
        what = f"{folder}: tables of {len(runs)} runs, {policies} policies"
        checks.append((what, folder, partial(_of_store, one, results)))
    for name in () if presets else STUDIES:
        of = study(name)
        file = results / (of.file if issubclass(of, OfOneFile) else name)
        what = f"Study {name}: its text against its data"
        checks.append((what, file, partial(of.problems, results)))
    for what, path, check in checks:
        yield what, []
        if problems := named(path, check):
            yield "", problems
            differs = True
    if presets:
        return
    for folder in others(results):
        yield f"{folder}: not looked at; --preset FILE says what is in it", []
    if differs:
        yield "Pages: not looked at until these differences are fixed", []
    else:
        yield from blocks.check(results, all_blocks(results))
