"""What a model file may name.

Stable-Baselines3 keeps a model's settings in pickles, and a pickle can call whatever it names: to
load a file is to run its author's program. Here it may name the classes and functions of the list
below and nothing else: spaces, arrays, schedules, and the parts that a model of Rainbow is made of.
"""

import base64
import io
import json
import pickle
import zipfile
from collections.abc import Collection
from enum import EnumMeta
from typing import Any

from sb3_rainbow.rainbow import Rainbow

_KNOWN = {
    "builtins": "bytearray complex frozenset range set slice",
    "collections": "OrderedDict deque",
    "gymnasium.spaces.box": "Box",
    "gymnasium.spaces.dict": "Dict",
    "gymnasium.spaces.discrete": "Discrete",
    "gymnasium.spaces.multi_binary": "MultiBinary",
    "gymnasium.spaces.multi_discrete": "MultiDiscrete",
    "numpy": "dtype ndarray",
    "numpy._core.multiarray": "_reconstruct scalar",
    "numpy._core.numeric": "_frombuffer",
    "numpy.core.multiarray": "_reconstruct scalar",
    "numpy.core.numeric": "_frombuffer",
    "numpy.random._pcg64": "PCG64",
    "numpy.random._pickle": "__bit_generator_ctor __generator_ctor",
    "numpy.random.bit_generator": "SeedSequence __pyx_unpickle_SeedSequence",
    "rl_zoo3.utils": "SimpleLinearSchedule",
    "sb3_rainbow.network.convolutions": "NatureConvolutions",
    "sb3_rainbow.policies": "CnnPolicy MultiInputPolicy RainbowPolicy",
    "sb3_rainbow.replay.buffers": "PrioritizedReplayBuffer",
    "stable_baselines3.common.buffers": "DictReplayBuffer NStepReplayBuffer ReplayBuffer",
    "stable_baselines3.common.running_mean_std": "RunningMeanStd",
    "stable_baselines3.common.torch_layers": "CombinedExtractor FlattenExtractor NatureCNN",
    "stable_baselines3.common.type_aliases": "TrainFreq TrainFrequencyUnit",
    "stable_baselines3.common.utils": "ConstantSchedule FloatSchedule LinearSchedule",
    "stable_baselines3.common.vec_env.vec_normalize": "VecNormalize",
    "stable_baselines3.her.goal_selection_strategy": "GoalSelectionStrategy",
    "stable_baselines3.her.her_replay_buffer": "HerReplayBuffer",
    "torch.nn.modules.activation": "ELU GELU LeakyReLU ReLU SiLU Tanh",
    "torch.optim.adam": "Adam",
    "torch.optim.adamw": "AdamW",
    "torch.optim.rmsprop": "RMSprop",
    "torch.optim.sgd": "SGD",
}
_ALLOWED = frozenset(
    f"{module}.{name}" for module, names in _KNOWN.items() for name in names.split()
)


class UnknownCodeError(ValueError):
    """A file names code that it may not."""


class _Members:
    """Stands for ``getattr``, by which Python up to 3.11.3 pickles an enumeration's members."""

    called = False

    def __call__(self, kind: Any, name: str) -> Any:
        if not isinstance(kind, EnumMeta) or name not in kind.__members__:
            raise UnknownCodeError(
                f"it wants to run builtins.getattr for {name!r} of {kind!r}, which is no member of "
                "an enumeration"
            )
        self.called = True
        return kind[name]


class _Unpickler(pickle.Unpickler):
    def __init__(self, pickled: bytes, trusted: Collection[str]) -> None:
        super().__init__(io.BytesIO(pickled))
        self._allowed = _ALLOWED | set(trusted)
        self._members: _Members | None = None

    def find_class(self, module: str, name: str) -> Any:
        # A name with a dot would lead from a module that is known to one that is not.
        if "." not in name and f"{module}.{name}" in self._allowed:
            return super().find_class(module, name)
        if (module, name) != ("builtins", "getattr"):
            raise _refusal(module, name)
        self._members = self._members or _Members()
        return self._members

    def load(self) -> Any:
        found = super().load()
        if self._members is not None and not self._members.called:
            raise _refusal("builtins", "getattr")
        return found


def _refusal(module: str, name: str) -> UnknownCodeError:
    return UnknownCodeError(
        f"it wants to run {module}.{name}, which is not among what Rainbow's files need; "
        f"if you trust its author, pass trusted={[f'{module}.{name}']}"
    )


def unpickle(pickled: bytes, trusted: Collection[str] = ()) -> Any:
    """What a pickle holds.

    Args:
        pickled: as it was written.
        trusted: names that are allowed besides those of this module.

    Raises:
        UnknownCodeError: if it names another; that is not imported, let alone called.
    """
    return _Unpickler(pickled, trusted).load()


def check_model(file: io.BytesIO, trusted: Collection[str], skipped: Collection[str]) -> None:
    """Look through all that loading a model would unpickle; torch looks after the tensors itself.

    Args:
        file: as ``save`` wrote it.
        trusted: names that are allowed besides those of this module.
        skipped: settings that are not going to be loaded.

    Raises:
        UnknownCodeError: if it names code that it may not.
    """
    with zipfile.ZipFile(file) as archive:
        settings: dict[str, Any] = json.loads(archive.read("data"))
    for name, value in settings.items():
        if name == "env" or callable(getattr(Rainbow, name, None)):
            raise UnknownCodeError(f"it wants to set {name}, which no model of Rainbow saves")
        if name not in skipped and isinstance(value, dict) and ":serialized:" in value:
            unpickle(base64.b64decode(value[":serialized:"]), trusted)
