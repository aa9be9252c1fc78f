"""The command `approxjac`: arguments → a command.

Exit codes: 0 all is well, 1 a verdict fell short, 2 bad input.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable

import tyro

import approxjac
from approxjac.cli.options import scenario_of, with_options
from approxjac.cli.paper import paper
from approxjac.cli.robots import robots
from approxjac.cli.simulate import simulate
from approxjac.cli.stability import stability, DEFAULTS
from approxjac.cli.view import view
from approxjac.errors import ApproxJacError, UnknownNameError
from approxjac.scenario import Scenario

_DESCRIPTION = (
    "Torque control of any URDF arm whose kinematics are not exactly known. "
    "COMMAND --help says more of each command, with examples; --version prints the version; "
    "exit codes are 0, 1 where a verdict fell short, and 2 for bad input."
)
