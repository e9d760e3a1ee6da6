"""A pickle that calls something when it is loaded, and files with contents of someone else's."""

import base64
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any


class Calling:
    """Unpickled, a folder."""

    def __reduce__(self) -> Any:
        return os.mkdir, ("called",)


CALL = pickle.dumps(Calling())


def rewritten(
    source: Path,
    target: Path,
    change: Callable[[str, bytes], bytes] = lambda name, content: content,
    compression: int = zipfile.ZIP_STORED,
) -> Path:
    """A copy of an archive whose contents, by name, are changed."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", compression) as new:
        for name in old.namelist():
            new.writestr(name, change(name, old.read(name)))
    return target


def tampered(model: Path, target: Path, *names: str) -> Path:
    """A file of SB3's own form, of which these settings are the pickle."""
    serialized = {":type:": "?", ":serialized:": base64.b64encode(CALL).decode()}

    def change(name: str, content: bytes) -> bytes:
        if name != "data":
            return content
        return json.dumps(json.loads(content) | dict.fromkeys(names, serialized)).encode()

    return rewritten(model, target, change)
