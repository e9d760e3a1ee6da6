"""Models of Rainbow as files of numbers, text and arrays; reading one runs no code.

A file is a zip of ``settings.json`` and ``arrays.safetensors``; it holds no pickle, and none is
read. Settings are checked against the signatures of the constructors that take them. A class is
named, and :data:`CLASSES` has all names there are. The shapes of the arrays are compared with those
of the network that the settings describe before memory is asked for.
"""

import inspect
import json
import os
import pathlib
import types
import zipfile
from collections.abc import Callable
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.type_aliases import GymEnv, TrainFreq
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from torch import nn

from sb3_rainbow.network.convolutions import NatureConvolutions
from sb3_rainbow.policies import CnnPolicy, MultiInputPolicy, RainbowPolicy
from sb3_rainbow.rainbow import Rainbow
from sb3_rainbow.replay.buffers import PrioritizedReplayBuffer
from sb3_rainbow.settings import NETWORK_ARGUMENTS, head_and_support, support_of
from sb3_rainbow.zoo.files import SETTINGS, ZooError, loading

Arrays = dict[str, NDArray[Any]]
SelfRainbow = TypeVar("SelfRainbow", bound=Rainbow)

#: What a file may name, by the setting that takes it.
CLASSES: dict[str, tuple[type, ...]] = {
    "policy": (RainbowPolicy, CnnPolicy, MultiInputPolicy),
    "replay_buffer_class": (
        *(PrioritizedReplayBuffer, ReplayBuffer, DictReplayBuffer),
        *(NStepReplayBuffer, HerReplayBuffer),
    ),
    "activation_fn": (nn.ELU, nn.GELU, nn.LeakyReLU, nn.ReLU, nn.SiLU, nn.Tanh),
    "features_extractor_class": (
        *(FlattenExtractor, NatureCNN, CombinedExtractor, NatureConvolutions),
    ),
    "optimizer_class": (th.optim.Adam, th.optim.AdamW, th.optim.RMSprop, th.optim.SGD),
}
_ARRAYS = "arrays.safetensors"
_MODEL, _STATISTICS = "Rainbow 1", "VecNormalize 1"
# Arguments that say where and how to compute, not what
_OF_THE_MACHINE = {
    *("self", "env", "tensorboard_log", "verbose", "seed", "device"),
    *("cpu_kernels", "_init_setup_model"),
}
_MOST_STEPS, _MOST_ROOM = 1_000, 1_000_000
_Integer = Literal["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"]
# Arguments of the spaces that are neither boxes nor made of others, and their types in JSON
_SPACES: dict[type[spaces.Space[Any]], dict[str, Any]] = {
    spaces.Discrete: {"n": int, "start": int, "dtype": _Integer},
    spaces.MultiDiscrete: {"nvec": list[Any], "start": list[Any], "dtype": _Integer},
    spaces.MultiBinary: {"n": int | list[int]},
}
_COUNTERS: dict[str, type] = {
    "num_timesteps": int,
    "_n_updates": int,
    "exploration_rate": float,
    "_masking": bool,  # whether it learned under masks
}


def write_model(model: Rainbow, path: str | os.PathLike[str]) -> None:
    """Write what acting needs, and the settings of the training.

    The optimizer's averages, the replay buffer and the random generators are left out.

    Raises:
        ZooError: naming each setting that has no form without a pickle.
    """
    given = {name: getattr(model, name) for name in _HINTS if hasattr(model, name)}
    given |= {"policy": model.policy_class, "stats_window_size": model._stats_window_size}
    if not model._tau_was_chosen:
        given["tau"] = None
    weights = {name: value.cpu().numpy() for name, value in model.policy.state_dict().items()}
    arrays = {f"policy.{name}": np.ascontiguousarray(value) for name, value in weights.items()}
    unwritable: list[str] = []

    def plain(name: str, value: Any, hint: Any) -> Any:
        try:
            result = _plain(name, value)
            if not _fits(json.loads(json.dumps(result, allow_nan=False)), hint):
                raise TypeError
        except (TypeError, ValueError):
            unwritable.append(f"{name} = {value!r}")
            return None
        return result

    kwargs = model.policy_kwargs
    settings = {
        "format": _MODEL,
        "arguments": {name: plain(name, value, _HINTS[name]) for name, value in given.items()},
        "policy_kwargs": {key: plain(key, kwargs[key], _POLICY_HINTS.get(key)) for key in kwargs},
        "counters": {name: kind(getattr(model, name)) for name, kind in _COUNTERS.items()},
    }
    for name in ("observation_space", "action_space"):
        try:
            settings[name] = _write_space(getattr(model, name), name, arrays)
        except TypeError as error:
            unwritable.append(f"{name} = {error}")
    if model.n_steps > _MOST_STEPS:  # which no file may ask for
        unwritable.append(f"n_steps = {model.n_steps}")
    if unwritable:
        raise ZooError(
            f"the model cannot be packaged, as only a pickle could hold {'; '.join(unwritable)}: "
            "change that, or share what model.save() writes with who trusts you"
        )
    _check_shapes(model, {name: value.shape for name, value in weights.items()})
    _write(path, settings, arrays)


def read_model(
    path: str | os.PathLike[str],
    kind: type[SelfRainbow] = Rainbow,  # type: ignore[assignment]
    env: GymEnv | None = None,
    device: th.device | str = "auto",
    **changed: Any,
) -> SelfRainbow:
    """Read a model that :func:`write_model` wrote.

    Args:
        kind: class of the model.
        env: environment to go on learning in.
        changed: arguments of the constructor that differ from those in the file. Without an ``env``
            the ``buffer_size`` is the smallest, with one the file's, a million at most.

    Raises:
        ZooError: if the file is of another form, damaged, or does not fit together.
    """
    with loading(path):
        settings, arrays = _read(path, _MODEL)
        arguments = _checked(settings.pop("arguments"), _HINTS)
        for given in (arguments, arguments.get("replay_buffer_kwargs") or {}):
            n_steps = given.get("n_steps", 1)  # the smallest buffer holds one return
            if not isinstance(n_steps, int) or n_steps > _MOST_STEPS:
                raise ValueError(f"n_steps cannot be {n_steps!r}: at most {_MOST_STEPS}")
        room = 1 if env is None else min(arguments.get("buffer_size", _MOST_ROOM), _MOST_ROOM)
        policy_kwargs = _checked(settings.pop("policy_kwargs"), _POLICY_HINTS)
        counters = _checked(settings.pop("counters"), _COUNTERS)
        own_spaces = {name: _read_space(value, name, arrays) for name, value in settings.items()}
        support = support_of(
            *head_and_support(*map(arguments.get, ("distributional", "v_min", "v_max")))
        )
        model = kind(
            env=None,  # type: ignore[arg-type]
            device=device,
            policy_kwargs=policy_kwargs,
            _init_setup_model=False,
            **{**arguments, "buffer_size": room, **changed},
        )
        model.observation_space = own_spaces["observation_space"]
        model.action_space = own_spaces["action_space"]  # type: ignore[assignment]
        model._support, model.n_envs = support, 1
        weights = {name.removeprefix("policy."): array for name, array in arrays.items()}
        _check_shapes(model, {name: array.shape for name, array in weights.items()})
        if env is not None:
            wrapped = kind._wrap_env(env, model.verbose)
            model.n_envs = wrapped.num_envs
            model.set_env(wrapped)
        model._setup_model()
        tensors = {name: th.from_numpy(array.copy()) for name, array in weights.items()}
        model.set_parameters({"policy": tensors}, exact_match=False)  # type: ignore[dict-item]
        for name, value in counters.items():
            setattr(model, name, value)
        return model


def write_statistics(normalizer: VecNormalize, path: str | os.PathLike[str]) -> None:
    """Write the statistics and settings of a ``VecNormalize``."""
    arrays = {
        f"{name}.{part}": np.asarray(getattr(statistics, part), np.float64)
        for name, statistics in _statistics(normalizer).items()
        for part in ("mean", "var", "count")
    }
    settings = {name: _plain(name, getattr(normalizer, name)) for name in _NORMALIZER_HINTS}
    for name in ("clip_obs", "clip_reward"):  # JSON knows no infinity
        settings[name] = min(settings[name], float(np.finfo(np.float32).max))
    _write(path, {"format": _STATISTICS, "arguments": settings}, arrays)


def read_statistics(path: str | os.PathLike[str], venv: VecEnv) -> VecNormalize:
    """A ``VecNormalize`` around ``venv`` for evaluation, from :func:`write_statistics`.

    Raises:
        ZooError: if the file is of another form, or its statistics are of other observations.
    """
    with loading(path):
        settings, arrays = _read(path, _STATISTICS)
        arguments = _checked(settings["arguments"], _NORMALIZER_HINTS)
        normalizer = VecNormalize(venv, training=False, **arguments)
        normalizer.norm_reward = False
        for name, statistics in _statistics(normalizer).items():
            for part in ("mean", "var", "count"):
                array = arrays[f"{name}.{part}"]
                if array.shape != np.shape(getattr(statistics, part)):
                    raise ValueError(f"{name}.{part} has shape {array.shape}")
                setattr(statistics, part, array.copy() if array.shape else float(array))
        return normalizer


def take_statistics(path: pathlib.Path, env: VecEnv) -> None:
    """Give the ``VecNormalize`` of an env the statistics of a packaged model, if it has some."""
    if not path.is_file():
        return
    normalizer = unwrap_vec_normalize(env)
    if normalizer is None:
        raise ZooError(
            f"{path}: the model acts on normalized observations, this env does not normalize: add "
            "--hyperparams normalize:True"
        )
    stored = read_statistics(path, normalizer.venv)
    normalizer.obs_rms, normalizer.ret_rms = stored.obs_rms, stored.ret_rms


def _statistics(normalizer: VecNormalize) -> dict[str, RunningMeanStd]:
    statistics = {"returns": normalizer.ret_rms}
    if normalizer.norm_obs:
        of_observations: Any = normalizer.obs_rms
        if not isinstance(of_observations, dict):
            of_observations = {"": of_observations}
        statistics |= {f"observations.{key}": value for key, value in of_observations.items()}
    return statistics


def _write(path: str | os.PathLike[str], settings: dict[str, Any], arrays: Arrays) -> None:
    text = json.dumps(settings, indent=1, allow_nan=False) + "\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(SETTINGS, text)
        archive.writestr(_ARRAYS, save_arrays(arrays))


def _read(path: str | os.PathLike[str], kind: str) -> tuple[dict[str, Any], Arrays]:
    """Settings, without their format, and arrays."""
    with zipfile.ZipFile(path) as archive:
        if SETTINGS not in archive.namelist():
            raise ValueError(
                "it was not packaged. A file that model.save() or VecNormalize.save() wrote can "
                "run its author's code when it is loaded; if you trust them, pass trust=True"
            )
        if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
            raise ValueError("it is compressed, which no packaged file is")
        settings = json.loads(archive.read(SETTINGS), parse_constant=_refuse)
        form = settings.pop("format")
        if form != kind:
            raise ValueError(f"its format is {form!r}, expected {kind!r}")
        return settings, load_arrays(archive.read(_ARRAYS))


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number")


def _hints_of(function: Callable[..., Any], left_out: set[str]) -> dict[str, Any]:
    return {
        name: str | None if name in CLASSES else parameter.annotation
        for name, parameter in inspect.signature(function).parameters.items()
        if name not in left_out
    }


# What a file holds of the constructors' arguments, and their types in JSON
_HINTS = {
    **_hints_of(Rainbow.__init__, _OF_THE_MACHINE | {"policy_kwargs"}),
    **{"learning_rate": float | dict[str, float], "train_freq": tuple[int, str]},
}
_POLICY_HINTS = _hints_of(
    RainbowPolicy.__init__,
    {"self", "observation_space", "action_space", "lr_schedule", "network"},
)
_NORMALIZER_HINTS = _hints_of(VecNormalize.__init__, {"self", "venv", "training"})


def _checked(settings: dict[str, Any], hints: dict[str, Any]) -> dict[str, Any]:
    """Settings as a constructor takes them."""
    for name, value in settings.items():
        if name not in hints:
            raise ValueError(f"unknown setting {name}")
        if not _fits(value, hints[name]):
            raise ValueError(f"{name} cannot be {value!r}")
    return {name: _from_plain(name, value) for name, value in settings.items()}


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value of JSON is of a type."""
    kind, of = get_origin(hint), get_args(hint)
    if kind in (Union, types.UnionType):
        return any(_fits(value, one) for one in of)
    if kind is Literal:
        return isinstance(value, str) and value in of
    if kind is list:
        return isinstance(value, list) and all(_fits(each, of[0]) for each in value)
    if kind is tuple:
        return isinstance(value, list) and len(value) == len(of) and all(map(_fits, value, of))
    if kind is dict:
        return isinstance(value, dict) and all(_fits(each, of[1]) for each in value.values())
    if hint is float:
        return type(value) in (int, float)
    return hint is Any or type(value) is (types.NoneType if hint is None else hint)


def _plain(name: str, value: Any) -> Any:
    """A setting as JSON has it; raises ``TypeError`` if it has no such form."""
    if name in CLASSES and value is not None:
        if value not in CLASSES[name]:
            raise TypeError(value)
        return value.__name__
    if isinstance(value, FloatSchedule):
        value = value.value_schedule
    if isinstance(value, ConstantSchedule):
        return value.val
    if type(value).__name__ == "SimpleLinearSchedule":  # the zoo's
        value = LinearSchedule(value.initial_value, 0.0, 1.0)
    if isinstance(value, LinearSchedule):
        return vars(value)
    if isinstance(value, TrainFreq):
        return [value.frequency, value.unit.value]
    return value.item() if isinstance(value, np.generic) else value


def _from_plain(name: str, value: Any) -> Any:
    if name in CLASSES and value is not None:
        named = {kind.__name__: kind for kind in CLASSES[name]}
        if value not in named:
            raise ValueError(f"{name} cannot be {value!r}; known: {', '.join(named)}")
        return named[value]
    if name == "learning_rate" and isinstance(value, dict):
        return LinearSchedule(**value)
    return tuple(value) if name == "train_freq" else value


def _write_space(space: spaces.Space[Any], name: str, arrays: Arrays) -> dict[str, Any]:
    """A space as JSON has it; the bounds of boxes go to the arrays."""
    written: dict[str, Any] = {"type": type(space).__name__}
    if type(space) is spaces.Box:
        arrays |= {f"{name}.low": space.low, f"{name}.high": space.high}
    elif type(space) is spaces.Dict:
        parts = space.spaces.items()
        written["spaces"] = {key: _write_space(p, f"{name}.{key}", arrays) for key, p in parts}
    elif type(space) in _SPACES:
        for part in _SPACES[type(space)]:
            value = getattr(space, part)
            written[part] = str(value) if part == "dtype" else np.asarray(value).tolist()
    else:
        raise TypeError(space)
    return written


def _read_space(written: dict[str, Any], name: str, arrays: Arrays) -> spaces.Space[Any]:
    match written:
        case {"type": "Box"}:
            low, high = arrays.pop(f"{name}.low"), arrays.pop(f"{name}.high")
            return spaces.Box(low.copy(), high.copy(), dtype=low.dtype.type)
        case {"type": "Dict", "spaces": dict(parts)}:
            # a sequence, whose order stays
            read = {key: _read_space(part, f"{name}.{key}", arrays) for key, part in parts.items()}
            return spaces.Dict(list(read.items()))
    named = {kind.__name__: kind for kind in _SPACES}
    try:
        kind = named[written["type"]]
        parts = {part: value for part, value in written.items() if part != "type"}
        return kind(**_checked(parts, _SPACES[kind]))
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"{name} cannot be {written!r}") from None


def _check_shapes(model: Rainbow, shapes: dict[str, tuple[int, ...]]) -> None:
    """Raise ``ZooError`` for weights of another network than the model's settings describe."""
    # on torch's device without memory, where a network of any size costs nothing
    blank: Any = type("Blank", (model.policy_class,), {"device": th.device("meta")})
    network = {name: getattr(model, name) for name in NETWORK_ARGUMENTS}
    with th.device("meta"):
        policy = blank(
            model.observation_space,
            model.action_space,
            ConstantSchedule(0.0),
            **network,
            **model.policy_kwargs,
        )
    wanted = {name: tuple(value.shape) for name, value in policy.state_dict().items()}
    for name in sorted(wanted.keys() | shapes.keys()):
        if wanted.get(name) != shapes.get(name):
            raise ZooError(
                f"{name} has shape {shapes.get(name)}, the settings say {wanted.get(name)}"
            )
