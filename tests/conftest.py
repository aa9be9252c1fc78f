import os

import numpy as np
import pytest
from hypothesis import settings

import approxjac as aj
from approxjac.robots.named import NAMED

settings.register_profile("default", deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("default")


@pytest.fixture(scope="session", params=sorted(NAMED))
def arm(request: pytest.FixtureRequest) -> aj.Robot:
    """Every robot that loads by name."""
    return aj.load_robot(request.param)


@pytest.fixture(scope="session")
def two_link() -> aj.Robot:
    """The paper's arm with its object, a thin rod."""
    return aj.load_robot("two_link").with_object(0.5, 0.5, radius=0.0, axis="x")


@pytest.fixture(scope="session")
def panda() -> aj.Robot:
    return aj.load_robot("panda")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261121)
