"""The sole owner of the layout of ``results/``.

    results/<preset>/store.json         the schema version
    results/<preset>/runs/<cell id>/    config.yaml meta.json curve.csv episodes.csv policy.zip
                                        checkpoint/ tensorboard/  (working files, not in git)
    results/<preset>/entries/<cell id>/ methods that others brought: config.yaml meta.json
                                        episodes.csv
    results/<preset>/tables/            *.csv *.md *.tex
    results/<preset>/figures/           *.png

Every file is written beside its place and renamed into it, so a reader sees the old file or the
new one. A run is complete when its meta.json is there: it is written last.
"""

import copy
import csv
import hashlib
import io
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final, Self

import pandas as pd
import yaml
from filelock import FileLock, Timeout

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.presets import SAFE_LOADER

SCHEMA: Final = 1
WORDS: Final = ("track.description",)  # settings that decide no result
PROGRESS_SECONDS: Final = 0.5  # between two reports of a run
BROKEN: Final = "broken-"  # before the name of a checkpoint that could not be read


def sync(path: Path) -> None:
    """Flush a file, or a folder's list of names, to the disk, so that it survives a crash."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_atomic(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, flush it, and rename it into place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        sync(temporary)
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` atomically as UTF-8."""
    write_atomic(path, lambda temporary: temporary.write_bytes(text.encode()))


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write rows of equal keys atomically."""
    write_text(path, csv_text(rows))


def csv_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Rows of equal keys; floats with seven digits, truth values as 0 and 1."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [*rows[0]] if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: _cell_text(value) for key, value in row.items()} for row in rows)
    return text.getvalue()


def _cell_text(value: object) -> object:
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        return "" if value != value else f"{value:.7g}"
    return "" if value is None else value


def changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """``key: old -> new`` of the settings that two runs do not share."""
    if old == new:
        return []
    flat, other = map(_decisive, (old, new))
    return [
        f"{key}: {flat.get(key, 'absent')} -> {other.get(key, 'absent')}"
        for key in sorted(flat.keys() | other.keys())
        if flat.get(key) != other.get(key)
    ]


def digest(settings: Mapping[str, Any]) -> str:
    """SHA-256 of settings, as far as they decide a result."""
    return hashlib.sha256(json.dumps(_decisive(settings), sort_keys=True).encode()).hexdigest()


def _decisive(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by their keys with dots, without those that decide no result."""
    flat = pd.json_normalize(dict(settings)).to_dict("records")[0]
    if (settings.get("track") or {}).get("shield") == {}:  # of the usual margins; none is None
        flat["track.shield"] = {}
    return {str(key): value for key, value in flat.items() if key not in WORDS}


@lru_cache(maxsize=10_000)  # problems, tables, figures and pages ask for the same files
def _parsed(path: Path, parse: Callable[[Path], Any], version: tuple[int, ...]) -> Any:
    return parse(path)


def _version(path: Path) -> tuple[int, ...]:
    now = path.stat()
    return now.st_ino, now.st_size, now.st_mtime_ns


def _mapping(parse: Callable[[str], Any], part: str, path: Path) -> dict[str, Any]:
    if not isinstance(data := parse(path.read_text(encoding="utf-8")), dict):
        raise ValueError("no mapping")
    if not isinstance(data.get(part, {}), dict):
        raise ValueError(f"'{part}' is no mapping")
    return data


_from_json = partial(_mapping, json.loads, "training")
_from_yaml = partial(_mapping, partial(yaml.load, Loader=SAFE_LOADER), "cell")


class RunFolder:
    """The files of one cell; BenchmarkError where one that is read is missing or damaged."""

    def __init__(self, path: Path) -> None:
        self.path, self.id = path, path.name
        self.policy = path / "policy.zip"
        self.checkpoint = path / "checkpoint"
        self.tensorboard = path / "tensorboard"
        self.log = self.checkpoint / "log.txt"
        self._reported = time.perf_counter()

    def is_complete(self) -> bool:
        """Whether the run has ended and its results are stored."""
        return (self.path / "meta.json").is_file()

    def has_policy(self) -> bool:
        """Whether the run is complete and its policy is here: not every one is kept in git."""
        return self.is_complete() and self.policy.is_file()

    def versions(self) -> tuple[object, ...]:
        """Versions of the files, which change whenever a file does."""
        files = (path for path in sorted(self.path.glob("*")) if path.is_file())
        return tuple((path.name, *_version(path)) for path in files)

    def policy_digest(self) -> str:
        """SHA-256 of the policy's file, which meta.json keeps as ``training.policy_sha256``."""
        return hashlib.sha256(self.policy.read_bytes()).hexdigest()

    def begin(self, config: Mapping[str, Any]) -> None:
        """Claim the folder for ``config``; BenchmarkError if it holds a run with other settings."""
        self.check_config(config)
        for left in self.path.glob(".*.tmp*"):  # of a process that was killed while it wrote
            left.unlink(missing_ok=True)
        if not (self.path / "config.yaml").is_file():
            text = yaml.safe_dump(dict(config), sort_keys=False)
            write_text(self.path / "config.yaml", text)

    def check_alike(self, other: str, config: Mapping[str, Any]) -> None:
        """Raise BenchmarkError if another seed's run ``other`` has other settings than this one."""
        mine, theirs = ({**each, "cell": None} for each in (self.config(), config))
        if changed := changes(mine, json.loads(json.dumps(theirs))):
            raise BenchmarkError(
                f"{self.path} and {other} differ in more than their seed "
                f"({'; '.join(changed[:4])}): they are no runs of one method; delete one, "
                "or move it away"
            )

    def check_config(self, config: Mapping[str, Any]) -> None:
        """Raise BenchmarkError if the folder holds a run with other settings than ``config``."""
        if not (self.path / "config.yaml").is_file():
            return
        if changed := changes(self.config(), json.loads(json.dumps(config))):
            raise BenchmarkError(
                f"{self.path} holds a run with other settings ({'; '.join(changed[:4])}); "
                "use another --results folder, or delete that one"
            )

    def config(self) -> dict[str, Any]:
        """The run's settings."""
        return self._read("config.yaml", _from_yaml)

    def meta(self) -> dict[str, Any]:
        """What the run says of itself: commit, versions, machine, seeds, time, steps."""
        meta = self._read("meta.json", _from_json)
        if meta.get("schema") != SCHEMA:
            raise BenchmarkError(
                f"{self.path / 'meta.json'} has results schema {meta.get('schema')}, this version "
                f"reads {SCHEMA}; move {self.path} away"
            )
        return meta

    def seconds(self, clock: str = "wall") -> float:
        """Time that the complete run took, by the clock ``wall`` or ``cpu``."""
        meta, name = self.meta(), f"{clock}_seconds"
        # runs of the classic tasks once kept it with the training alone
        seconds = meta.get(name) or meta.get("training", {}).get(name)
        if not isinstance(seconds, int | float):
            raise BenchmarkError(
                f"{self.path / 'meta.json'} lacks '{name}', a number; delete {self.path} and run "
                "the preset again"
            )
        return float(seconds)

    def _read(self, name: str, parse: Callable[[Path], Any]) -> Any:
        path = self.path / name
        try:
            # whoever asked may change it
            return copy.deepcopy(_parsed(path, parse, _version(path)))
        except (OSError, ValueError, yaml.YAMLError) as error:
            raise BenchmarkError(
                f"{path} cannot be read ({error}); delete {self.path} and run the preset again"
            ) from error

    def write_meta(self, meta: Mapping[str, Any]) -> None:
        """Write meta.json, which makes the run complete."""
        text = json.dumps({"schema": SCHEMA, **meta}, indent=1, sort_keys=True)
        write_text(self.path / "meta.json", text + "\n")

    def write_rows(self, name: str, rows: Sequence[Mapping[str, object]]) -> None:
        """Write ``<name>.csv`` (curve, episodes, design)."""
        write_csv(self.path / f"{name}.csv", rows)

    def rows(self, name: str, *columns: str) -> pd.DataFrame:
        """Read ``<name>.csv``, which must have ``columns``."""
        rows: pd.DataFrame = self._read(f"{name}.csv", pd.read_csv)
        if missing := {*columns} - {*rows}:
            raise BenchmarkError(
                f"{self.path / name}.csv lacks the column '{min(missing)}'; delete {self.path} and "
                "run the preset again"
            )
        return rows

    def curve(self, *columns: str) -> pd.DataFrame:
        """Read curve.csv, which must have ``columns``, numbers alone, and be whole."""
        path, rows = self.path / "curve.csv", self.rows("curve", "timesteps", *columns)
        end = self.meta().get("training", {}).get("timesteps")
        if not path.read_bytes().endswith(b"\n") or rows["timesteps"].tolist()[-1:] != [end]:
            fault = f"is cut off before the training's end, step {end}"
        elif rows.select_dtypes("number").shape != rows.shape:
            fault = "holds what is no number"
        else:
            return rows
        raise BenchmarkError(f"{path} {fault}; delete {self.path} and run the preset again")

    def has_rows(self, name: str) -> bool:
        return (self.path / f"{name}.csv").is_file()

    def write_progress(self, done: float, note: str) -> None:
        """Report the run's progress (0 to 1) to the harness that waits for it."""
        text = json.dumps({"done": done, "note": note})
        with suppress(OSError):  # a full disk ends no run just because of this file
            write_text(self.checkpoint / "progress.json", text)

    def report(self, done: float, note: Callable[[], str]) -> None:
        """As :meth:`write_progress`, but not more often than the harness looks."""
        now = time.perf_counter()
        if now - self._reported >= PROGRESS_SECONDS:
            self._reported = now
            self.write_progress(done, note())

    def progress(self) -> tuple[float, str]:
        """The run's progress (0 to 1), and a note."""
        if self.is_complete():
            return 1.0, "complete"
        try:
            data = json.loads((self.checkpoint / "progress.json").read_text(encoding="utf-8"))
            return min(1.0, max(0.0, float(data["done"]))), str(data["note"])
        except (OSError, ValueError, KeyError, TypeError):
            return 0.0, ""

    def lock(self, wait: float = 0.0) -> AbstractContextManager[None]:
        """Lock the run for one process; BenchmarkError if another holds it for ``wait`` seconds."""
        refusal = f"another process is at work on {self.path}; wait for it or stop it"
        return _held(self.path / "run.lock", refusal, wait)

    def drop_checkpoint(self) -> None:
        """Remove the working files of a run that is complete, but for checkpoints set aside."""
        for path in self.checkpoint.glob("*"):
            if path.is_dir() and not path.name.startswith(BROKEN):
                shutil.rmtree(path, ignore_errors=True)
            elif not path.is_dir():
                path.unlink(missing_ok=True)
        with suppress(OSError):  # something was set aside, or there is no such folder
            self.checkpoint.rmdir()


class Store:
    """The results of one preset."""

    def __init__(self, root: Path, preset: str) -> None:
        self.folder = Path(root) / preset
        self.entries = self.folder / "entries"
        self.tables = self.folder / "tables"
        self.figures = self.folder / "figures"

    @classmethod
    def open(cls, root: Path | str, preset: str, create: bool = False, path: str = "") -> Self:
        """Open a store, or ``create`` it; BenchmarkError if it is missing or of another schema.

        ``path``: the file of a user's own preset, by which commands find it.
        """
        store = cls(Path(root), preset)
        marker = store.folder / "store.json"
        # Listed first: whoever makes this store beside us writes the marker, from a temporary file,
        # before anything else.
        has_files = any(not path.match(".store.json.*.tmp") for path in store.folder.glob("*"))
        if marker.is_file():
            try:
                schema = json.loads(marker.read_text(encoding="utf-8"))["schema"]
            except (ValueError, KeyError, TypeError):
                schema = "unreadable"
            if schema != SCHEMA:
                raise BenchmarkError(
                    f"{store.folder} was written with results schema {schema}, this version reads "
                    f"{SCHEMA}; move it away or use another --results folder"
                )
        elif has_files:
            raise BenchmarkError(
                f"{store.folder} has files but no store.json: it is no results folder of this "
                "harness; use another --results folder"
            )
        elif create:
            write_text(marker, json.dumps({"schema": SCHEMA}) + "\n")
        else:
            raise BenchmarkError(
                f"{store.folder} has no results; run: python -m benchmarks run --preset "
                f"{path or preset}"
            )
        return store

    def lock(self) -> AbstractContextManager[None]:
        """Lock the store for one harness; BenchmarkError if another holds it."""
        refusal = f"another harness is at work in {self.folder}; wait for it, or use another "
        return _held(self.folder / "store.lock", f"{refusal}--results folder")

    def run(self, cell_id: str) -> RunFolder:
        """The folder of one cell, present or not."""
        return RunFolder(self.folder / "runs" / cell_id)

    def completed(self) -> list[RunFolder]:
        """All complete runs, by id."""
        return _complete(self.folder / "runs")

    def entered(self) -> list[RunFolder]:
        """All entries of others' methods, a folder per name and seed."""
        return _complete(self.entries)


def _complete(folder: Path) -> list[RunFolder]:
    runs = [RunFolder(path) for path in sorted(folder.glob("*"))]
    return [run for run in runs if run.is_complete()]


@contextmanager
def _held(path: Path, refusal: str, wait: float = 0.0) -> Iterator[None]:
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        lock = FileLock(str(path)).acquire(timeout=wait)
    except Timeout:
        raise BenchmarkError(refusal) from None
    with lock:
        yield
