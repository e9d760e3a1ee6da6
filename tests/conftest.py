"""Settings of all tests."""

from collections.abc import Iterator
from itertools import count

import pytest
from gymnasium.utils import seeding
from hypothesis import HealthCheck, settings

# the same examples everywhere, however slow the machine: by default each has 200 ms
settings.register_profile(
    "steady", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("steady")


@pytest.fixture(autouse=True, scope="module")
def _draws_repeat() -> Iterator[None]:
    """Environments and spaces that no test seeds draw in every run what they drew in the last."""
    seeds, draw = count(1_000_003), seeding.np_random
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            seeding, "np_random", lambda seed=None: draw(next(seeds) if seed is None else seed)
        )
        yield


# One worker compiles the kernels while the others do what needs none.
FIRST = ("test_kill.py", "test_docs.py", "test_verify.py")


@pytest.hookimpl(tryfirst=True)  # before the slow ones may be left out
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests come first: the short ones then fill the end of all workers."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path.name not in FIRST, item.path not in slow))
