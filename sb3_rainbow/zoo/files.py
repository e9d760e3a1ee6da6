"""The format of a model's file, and loading errors as one line."""

import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager

import stable_baselines3 as sb3

from sb3_rainbow.resume.checkpoint import members

ALGO = "rainbow"  # its name in the zoo, and in the names of files
SETTINGS = "settings.json"  # in a file that holds no pickle
VEC_NORMALIZE = "vec_normalize.zip"  # the statistics beside a packaged model


class ZooError(ValueError):
    """A command, file or model that the zoo cannot handle; the message needs no traceback."""


def is_model_file(path: str | os.PathLike[str]) -> bool:
    """Whether a file has the packaged form, of which nothing is run."""
    return SETTINGS in members(path)


@contextmanager
def loading(path: str | os.PathLike[str]) -> Iterator[None]:
    """Raise whatever the loading of a file raises as a :class:`ZooError` that names the file."""
    try:
        yield
    except Exception as error:  # pickle, zipfile and torch may raise anything
        reason = str(error).strip() or repr(error)
        raise ZooError(
            f"{os.fspath(path)} cannot be loaded as Rainbow: {reason}{_other_version(path)}"
        ) from error


def _other_version(path: str | os.PathLike[str]) -> str:
    try:
        with zipfile.ZipFile(path) as archive:
            saved = archive.read("_stable_baselines3_version").decode().strip()
    except (OSError, KeyError, zipfile.BadZipFile):
        return ""
    if saved == sb3.__version__:
        return ""
    return f" (saved by Stable-Baselines3 {saved}, this is {sb3.__version__})"
