"""The preset ``smoke`` with other settings: as data, built, or as a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from benchmarks.protocol.presets import PRESETS, Preset, parse_preset
from benchmarks.protocol.strict import merge


def smoke(track: Mapping[str, Any] | None = None, **changes: Any) -> dict[str, Any]:
    """The preset's data; ``track`` is laid over its track, ``changes`` replace the rest."""
    data: dict[str, Any] = yaml.safe_load((PRESETS / "smoke.yaml").read_text(encoding="utf-8"))
    data["tracks"]["safe"] = merge(data["tracks"]["safe"], track or {})
    return data | changes


def smoke_preset(name: str = "smoke", **changes: Any) -> Preset:
    return parse_preset(smoke(**changes), name, f"{name}.yaml")


def smoke_file(folder: Path, name: str, **changes: Any) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(smoke(**changes)), encoding="utf-8")
    return path
