"""The final policy of a run as a file small enough to commit, which SB3 loads like any other.

What acting does not need (target network, optimizer) is dropped, but no sigma of the noise. What is
left is rounded to half precision before the test, so that the file *is* what was tested. meta.json
keeps the digest of the trained weights, by which two runs can be compared to the bit.
"""

import hashlib
import io
import zipfile
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import torch

from benchmarks.runs.store import write_atomic

# what Rainbow, DQN or an actor-critic never needs to act, and what noisy layers draw anew
_UNUSED: Final = (
    *("q_net_target.", "quantile_net_target.", "mlp_extractor.value_net.", "value_net."),
    *("critic.", "critic_target.", "actor_target."),
)
_KNOWN: Final = ("sb3_rainbow.", "stable_baselines3.", "sb3_contrib.", "benchmarks.")
_DRAWN: Final = (".epsilon_in", ".epsilon_out")


def digest(model: Any) -> str:
    """SHA-256 of all weights, by name and to the bit."""
    sha = hashlib.sha256()
    for name, value in sorted(model.policy.state_dict().items()):
        sha.update(name.encode())
        sha.update(value.detach().cpu().contiguous().numpy().tobytes())
    return sha.hexdigest()


def reduce_to_acting(model: Any) -> None:
    """Reduce the model, in place, to what acting needs, rounded to half precision."""
    # a user's own policy may need a part of such a name to act
    known = type(model.policy).__module__.startswith(_KNOWN)
    with torch.no_grad():
        for name, value in model.policy.state_dict().items():
            if not value.is_floating_point():
                continue
            if (known and name.startswith(_UNUSED)) or name.endswith(_DRAWN):
                value.zero_()
            elif value.abs().max() < torch.finfo(torch.float16).max:
                value.copy_(value.half())
    names, _ = model._get_torch_save_params()
    for result in (attrgetter(name)(model) for name in names):
        if isinstance(result, torch.optim.Optimizer):
            result.state.clear()


def save(model: Any, path: Path) -> None:
    """Write the model atomically, compressed; ``type(model).load(path)`` reads it."""
    stored = io.BytesIO()
    model.save(stored)

    def compress(temporary: Path) -> None:
        with (
            zipfile.ZipFile(stored) as source,
            zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as target,
        ):
            for entry in source.infolist():
                target.writestr(entry.filename, source.read(entry))

    write_atomic(path, compress)
