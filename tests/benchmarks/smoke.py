"""The preset ``smoke`` with other settings: as data, built, or as a file."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from benchmarks.protocol.presets import PRESETS, Preset, parse
from benchmarks.protocol.strict import merge

#: hyperparameters of teams
SMALL = {
    **{"n_envs": 4, "batch_size": 16, "buffer_size": 1000, "learning_starts": 60},
    **{"updates_per_step": 0.25, "net_arch": [16], "n_atoms": 5},
}


def smoke(track: Mapping[str, Any] | None = None, **changes: Any) -> dict[str, Any]:
    """The preset's data; ``track`` is laid over its track, ``changes`` replace the rest."""
    data: dict[str, Any] = yaml.safe_load((PRESETS / "smoke.yaml").read_text(encoding="utf-8"))
    data["tracks"]["safe"] = merge(data["tracks"]["safe"], track or {})
    return data | changes


def smoke_preset(name: str = "smoke", **changes: Any) -> Preset:
    return parsed(smoke(**changes), name)


def parsed(data: dict[str, Any], name: str = "mine") -> Preset:
    """A preset of the insertion task from what a file would hold."""
    preset = parse(data, name, f"{name}.yaml")
    assert isinstance(preset, Preset)
    return preset


def preset_file(folder: Path, data: Mapping[str, Any], name: str) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


def smoke_file(folder: Path, name: str, **changes: Any) -> Path:
    return preset_file(folder, smoke(**changes), name)


def stop_after(rounds: int) -> Callable[[], bool]:
    """Asks a run to stop once it has asked so often."""
    left = iter(range(rounds))
    return lambda: next(left, None) is None
