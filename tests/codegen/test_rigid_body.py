"""Kinematics and dynamics on symbols, compared with Pinocchio."""

import numpy as np
import pytest
from arm_terms import evaluated, largest_errors, traced
from random_trees import random_tree

import approxjac as aj
from approxjac.codegen.arm.arm_numbers import ArmNumbers, Structure, arm_numbers, reduced
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.robots import GravityRegressor
from approxjac.stability import Uncertainty


def require_agreement(errors, tolerance=1e-12):
    assert {name: error for name, error in errors.items() if not error <= tolerance} == {}


def test_terms_of_every_arm(arm, rng):
    errors = largest_errors([arm], [arm.tip], GravityRegressor(arm), rng)
    require_agreement(errors)


@pytest.mark.parametrize(
    "seed", [*range(5), *(pytest.param(k, marks=pytest.mark.study) for k in range(5, 20))]
)
def test_terms_of_random_trees(seed):
    rng = np.random.default_rng(seed)
    text, frames = random_tree(rng)
    robot = aj.Robot(text).with_gravity(rng.normal(size=3) * 6.0)
    try:
        regressor = GravityRegressor(robot)
    except InvalidInputError:
        regressor = None
    require_agreement(largest_errors([robot], frames, regressor, rng))


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.study)])
def test_terms_of_many_joints(seed):
    rng = np.random.default_rng(seed)
    text, frames = random_tree(rng, 18)
    robot = aj.Robot(text)
    require_agreement(largest_errors([robot], frames, None, rng))


STACKED = {
    "tool": {"object_length": (0.0, 0.3), "object_mass": (0.0, 1.0)},
    "origins": {
        "object_length": (0.1, 0.3),
        "believed_length": 0.1,
        "joint_shifts": {"panda_joint3": [0.01, 0.02, 0.01]},
        "joint_rotations": {"panda_joint5": [0.05, 0.05, 0.0], "panda_hand_joint": [0, 0.1, 0]},
    },
}


@pytest.mark.parametrize("known", STACKED)
def test_arms_that_differ_run_side_by_side(panda, rng, known):
    box = Uncertainty(panda, **STACKED[known])
    robots = [box.robot(values) for values in rng.uniform(box.low, box.high, (10, box.d))]
    require_agreement(largest_errors(robots, ["object_tip"], None, rng))


def test_numbers_that_are_the_same_are_constants(panda):
    box = Uncertainty(panda, object_length=(0.1, 0.3), believed_length=0.1)
    robots = [box.robot([length]) for length in (0.15, 0.2, 0.3)]
    program, _ = traced(robots, ["object_tip"])
    assert {name: size for name, (_, size) in program.parameters.items()} == {
        "arm.frame_translations": 1
    }
    assert traced([panda, panda], [panda.tip])[0].parameters == {}


def test_numbers_of_an_arm_depend_on_it_alone(panda, rng):
    box = Uncertainty(panda, object_mass=(0.0, 1.0), joint_rotations={"panda_joint2": [0.1] * 3})
    robots = [box.robot(values) for values in rng.uniform(box.low, box.high, (5, box.d))]
    structure = Structure.of(panda, ["panda_link4"])
    numbers = [arm_numbers(robot, ["panda_link4"]) for robot in robots]
    together = reduced(ArmNumbers.stacked(numbers), structure)
    for i, each in enumerate(numbers):
        for alone, part in zip(
            reduced(ArmNumbers.stacked([each]), structure), together, strict=True
        ):
            assert np.array_equal(alone[0], part[i])


def test_a_panda_costs_few_operations(panda):
    """What a plant and a controller that learns gravity need of it."""
    program, terms = traced([panda], [panda.tip], GravityRegressor(panda))
    names = ("forward", "Z", f"p {panda.tip}", f"J {panda.tip}")
    wanted = [number for name in names for number in np.ravel(terms[name]).tolist()]
    nodes = (program.graph.nodes[place] for place in program.graph.needed(wanted))
    assert sum(node.operation not in ("constant", "input") for node in nodes) <= 2000


def test_a_frame_of_the_base_stands_still(panda, rng):
    program, terms = traced([panda], ["panda_link0"])
    q = panda.random_configuration(rng)[np.newaxis]
    found = evaluated(program, terms, q, 0 * q, 0 * q)
    assert np.array_equal(found["R panda_link0"][0], np.eye(3))
    assert not found["J panda_link0"].any()


def test_refuses_a_frame_that_is_none(panda):
    with pytest.raises(UnknownNameError):
        traced([panda], ["elbow"])
