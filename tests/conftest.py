"""Settings of all tests."""

from hypothesis import HealthCheck, settings

# the same examples everywhere, however slow the machine: by default each has 200 ms
settings.register_profile(
    "steady", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("steady")
