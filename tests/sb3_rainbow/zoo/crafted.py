"""A pickle that calls something when it is loaded, and files of SB3's own form that hold it."""

import base64
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any


class Calling:
    """Unpickled, a folder."""

    def __reduce__(self) -> Any:
        return os.mkdir, ("called",)


CALL = pickle.dumps(Calling())


def tampered(model: Path, target: Path, *names: str) -> Path:
    """A file of SB3's own form, of which these settings are the pickle."""
    serialized = {":type:": "?", ":serialized:": base64.b64encode(CALL).decode()}
    with zipfile.ZipFile(model) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "data":
                content = json.dumps(
                    json.loads(content) | dict.fromkeys(names, serialized)
                ).encode()
            new.writestr(name, content)
    return target
