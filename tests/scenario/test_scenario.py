"""`Scenario`: the same from Python, a file and what it prints; wrong keys and values."""

import dataclasses
import types
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np
import pytest
from arms import light_wristed
from hypothesis import given
from hypothesis import strategies as st

import approxjac as aj
from approxjac.scenario import Scenario, build_scenario, recommended, run_scenario
from approxjac.scenario.convert import hints

EXAMPLES = sorted((Path(__file__).parents[2] / "examples" / "scenarios").glob("*.toml"))


def values(hint, bounds=None) -> Any:
    """Strategy for the values of a field."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return st.one_of([values(kind, bounds) for kind in inner])
    if origin is Literal:
        return st.sampled_from(inner)
    if origin is dict:
        return st.dictionaries(st.text(max_size=5), values(inner[1]), max_size=2)
    if origin is tuple and inner[-1] is Ellipsis:
        return st.lists(values(inner[0], bounds), max_size=3).map(tuple)
    if origin is tuple:
        return st.tuples(*(values(kind, bounds) for kind in inner))
    low = 1.0 if bounds else None
    return {
        float: st.floats(low, 1e9, allow_nan=False, allow_infinity=False),
        int: st.integers(20, 10**9),
        str: st.text(max_size=8),
        bool: st.booleans(),
        type(None): st.none(),
    }[hint]


def records(record):
    """Strategy for records of a kind, each field of which may be as it is."""
    fields = {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if dataclasses.is_dataclass(value):
            fields[field.name] = records(value)
        elif field.name != "robot":
            checks_itself = isinstance(record, aj.simulation.VelocityServo)
            made = values(hints(type(record))[field.name], field.metadata or checks_itself)
            # what is given by default otherwise than by None cannot be none again
            fields[field.name] = st.one_of(st.just(value), made)
    return st.builds(lambda **given: dataclasses.replace(record, **given), **fields)


@given(records(Scenario("panda")))
def test_what_a_scenario_prints_makes_the_same_scenario(tmp_path_factory, scenario):
    path = scenario.save(tmp_path_factory.getbasetemp() / "scenario.toml")
    assert Scenario.load(path) == scenario


def test_it_prints_what_differs_from_the_defaults_and_always_what_is_held():
    scenario = Scenario(
        "panda",
        true={"object": {"length": 0.3}, "shifts": {"panda_joint4": (0, 0.01, 0)}},
        controller={"kp": 400, "limits": "none"},
        run={"target": {"offset": (0.1, 0, 0)}},
    )
    assert str(scenario) == (
        'robot = "panda"\n\n[true]\nobject = { length = 0.3, mass = 0.5 }\n'
        "shifts = { panda_joint4 = [0.0, 0.01, 0.0] }\n\n"
        "[believed]\nobject = { length = 0.0, mass = 0.0 }\n\n"
        '[controller]\nkp = [400.0]\nlimits = "none"\n\n'
        "[run]\ntarget = { offset = [0.1, 0.0, 0.0] }\n"
    )
    held = "object = { length = 0.2, mass = 0.5 }", "object = { length = 0.0, mass = 0.0 }"
    usual = 'robot = "ur5"\n\n[true]\n{}\n\n[believed]\n{}\n'
    assert str(Scenario("ur5")) == usual.format(*held)
    assert scenario.true.object.mass == 0.5  # a table changes what it names


def test_an_object_may_point_anywhere():
    """As `with_object(axis=(0, 1, 1))` has it; in a file and as an option of the command line."""
    scenario = Scenario("ur5", true={"object": {"length": 0.2, "axis": (0, 1, 1)}})
    assert "axis = [0.0, 1.0, 1.0]" in str(scenario)
    arm = aj.load_robot("ur5").with_object(0.2, 0.5, axis=(0.0, 1.0, 1.0))
    assert build_scenario(scenario).plant.robot == arm
    with pytest.raises(aj.InvalidInputError, match="axis must be 3 numbers or a word, got 3"):
        Scenario("ur5", true={"object": {"axis": 3}})


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_are_built(path):
    built = build_scenario(Scenario.load(path))
    assert built.plant.sensor.value(built.q0).shape == built.target.shape


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"tru": {}}, "key 'tru' not in a scenario; did you mean 'true'"),
        ({"true": {"objct": {}}}, r"key 'objct' not in \[true\]; did you mean 'object'"),
        ({"true": 3}, "true must be a table of object, shifts, .*, got 3"),
        ({"run": {"seed": 1.5}}, "run.seed must be a whole number, got 1.5"),
        ({"run": {"seed": float("inf")}}, "run.seed must be a whole number, got inf"),
        ({"run": {"seed": -1}}, "run.seed must be a finite number >= 0, got -1"),
        ({"run": {"start": "rndom"}}, "run.start must be numbers or random, got 'rndom'"),
        ({"run": {"target": {"offst": (1,)}}}, r"key 'offst' not in \[run.target\]"),
        ({"controller": {"law": "pid"}}, "controller.law must be .*tracking.*, got 'pid'"),
        ({"controller": {"integral": "learnt"}}, "did you mean 'integral_action'"),
        ({"controller": {"gravity": "rest"}}, "controller.gravity must be .*learn_residual"),
        ({"controller": {"kp": (1, -1)}}, "controller.kp must be a finite number > 0, got -1"),
        ({"true": {"servo": {"lag": 0}}}, "true.servo.lag must be a finite number >= 0.001 ."),
        ({"sensor": {"lost": 3}}, "sensor.lost must be 2 numbers, got 3"),
        ({"sensor": {"noise": True}}, "sensor.noise must be a number, got True"),
        ({"believed": {"shifts": {"a": (1, 2)}}}, "believed.shifts must be 3 numbers for each"),
        ({"true": {"camera": {"size": (640, "b")}}}, "true.camera.size must be 2 numbers, got"),
    ],
)
def test_what_is_wrong_is_told_by_its_key(given, text):
    with pytest.raises(aj.errors.ApproxJacError, match=text) as caught:
        Scenario("panda", **given) if "tru" not in given else Scenario("panda").with_values(given)
    assert "\n" not in str(caught.value)


LEARNS = ("tool", "origins", "axes")


@pytest.mark.parametrize(
    ("parts", "law", "unknown"),
    [
        ({}, "tracking", LEARNS),
        ({"controller": {"limits": 0.5}, "true": {"drives": "usual"}}, "tracking", LEARNS),
        ({"sensor": {"velocity_filter": 5e-3}}, "tracking", LEARNS),
        ({"loop": {"actuator_delay": 2e-3}, "task": {"kind": "pose"}}, "tracking", LEARNS),
        ({"run": {"target": {"circle": {"radius": 0.1}}}}, "tracking", LEARNS),
        ({"controller": {"law": "tracking"}}, "tracking", ()),
        ({"controller": {"law": "setpoint"}}, "setpoint", ()),
        ({"controller": {"kp": 100.0}, "sensor": {"delay": 0.02}}, "setpoint", ()),
        ({"controller": {"gravity": "exact"}}, "setpoint", ()),
        ({"controller": {"gravity": "learnt"}}, "setpoint", ()),
        ({"controller": {"unknown": ["tool"]}}, "setpoint", ("tool",)),
        ({"true": {"tracker": {"rotation": (0.0, 0.0, 0.1)}}}, "setpoint", ()),
        ({"task": {"kind": "image"}}, "setpoint", ()),
        ({"loop": {"dt": "continuous"}, "controller": {"limits": "none"}}, "setpoint", ()),
    ],
)
def test_a_simulation_takes_what_suits_most_arms_unless_it_is_told(parts, law, unknown):
    scenario = Scenario("panda", **parts)
    chosen = recommended(scenario)
    assert (chosen.controller.law, chosen.controller.unknown) == (law, unknown)
    assert recommended(chosen) == chosen
    its_own = law == "tracking" and not parts.get("controller", {}).get("law")
    assert chosen.true.drives == ("usual" if its_own else None)
    told = scenario.with_values({"true": {"drives": "ideal"}}) if its_own else chosen
    assert recommended(told).true.drives == ("ideal" if its_own else None)
    built = build_scenario(chosen)
    assert built.plant.transmission.is_elastic == its_own
    assert (type(built.law) is aj.TrackingController) == (law == "tracking")
    assert (built.controller.kinematics is not None) == (unknown != () or law == "tracking")


@pytest.mark.parametrize("law", ["setpoint", "tracking"])
def test_gravity_is_learnt_by_either_law_unless_another_is_given(law):
    def learnt(**gravity):
        scenario = Scenario("panda", controller={"law": law, **gravity})
        return str(build_scenario(scenario).law)

    assert learnt() == learnt(gravity="learnt") != learnt(gravity="believed")


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("ur5", 31),
        *((name, seed) for name in ("ur3", "ur5") for seed in range(32, 36)),
    ],
)
def test_an_arm_with_a_light_wrist_reaches_its_target_within_four_seconds(tmp_path, name, seed):
    scenario = Scenario(
        str(light_wristed(tmp_path, name)),
        tip="tool0",
        true={"object": {"length": 0.2, "mass": 0.5}},
        run={"start": "random", "duration": 4.0, "seed": seed},
    )
    result = run_scenario(scenario)
    assert result.run.error_norm[-1] < 1e-3
    limits = result.built.plant.robot.velocity_limits
    assert (np.abs(result.run.v) <= 1.05 * limits).all()


@pytest.mark.parametrize(
    ("mass", "drives"),
    [
        (3.0, "ideal"),
        *(
            pytest.param(*each, marks=pytest.mark.study)
            for each in ((3.0, "usual"), (1.5, "ideal"), (1.5, "usual"))
        ),
    ],
)
def test_a_heavy_unknown_tool_on_a_light_wrist_neither_falls_nor_rings(tmp_path, mass, drives):
    """With a camera of 60 Hz: within 5 mm (rms) from 1 s to 3 s on, and no sag above 3 cm."""
    result = run_scenario(
        recommended(
            Scenario(
                str(light_wristed(tmp_path)),
                tip="tool0",
                true={"object": {"length": 0.2, "mass": mass}, "drives": drives},
                sensor={"rate": 60.0, "delay": 0.03, "noise": 1e-3},
                run={"duration": 3.0, "target": {"offset": (-0.05, 0.08, -0.05)}, "seed": 4},
            )
        )
    )
    run = result.run
    late = run.error_norm[run.t > 1.0]
    assert np.sqrt(np.mean(late**2)) < 5e-3
    assert min(run.x[0, 2], run.x_d[0, 2]) - run.x[:, 2].min() < 0.03
    assert not [each for each in run.events if each.condition.name == "OSCILLATES"]


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("xarm7", 1),
        *((name, seed) for name in ("ur5", "ur3", "panda") for seed in (0, 1)),
    ],
)
def test_limits_hold_where_a_rigid_joint_is_late(name, seed):
    """q̇ 5 ms and torques 2 ms late: what they do to q̈ is not looked for before it can show."""
    result = run_scenario(
        Scenario(
            name,
            true={"object": {"length": 0.2, "mass": 0.5}, "drives": "ideal"},
            sensor={"noise": 5e-4, "rate": 60.0, "q_quantum": 1e-5, "velocity_filter": 5e-3},
            loop={"actuator_delay": 2e-3},
            run={"start": "random", "duration": 6.0, "seed": seed},
        )
    )
    run = result.run
    assert run.error_norm[run.t > 5.0].max() < 2e-3
    assert (np.abs(run.v) < 1.1 * result.built.plant.robot.velocity_limits).all()


@pytest.mark.study
@pytest.mark.parametrize("seed", [601, 604, 606])
def test_limits_of_speed_do_not_make_elastic_joints_swing(seed):
    """Braked as hard as the lag of q̇ alone allows, links get to 2.4 times their limits."""
    run = {"start": "random", "duration": 3.0, "seed": seed}
    result = run_scenario(Scenario("kinova", controller={"limits": "urdf"}, run=run))
    assert result.built.plant.transmission.is_elastic
    fastest = np.abs(result.run.v).max(axis=0) / result.built.plant.robot.velocity_limits
    assert 0.9 < fastest.max() < 1.1


@pytest.mark.study
@pytest.mark.parametrize("seed", [1, 3])
def test_a_small_arm_learns_how_its_joints_rub(seed):
    """5 % of the efforts, behind rotors ten times as heavy as its links: 1 mm after 2 s."""
    truth = {"object": {"length": 0.1, "mass": 0.1}, "drives": "usual"}
    run = {"start": "random", "duration": 3.0, "seed": seed}
    result = run_scenario(recommended(Scenario("so101", true=truth, run=run)))
    assert result.run.error_norm[result.run.t > 2.0].max() < 1e-3


@pytest.mark.parametrize(
    ("name", "seed", "bits"),
    [
        pytest.param(name, seed, bits, marks=pytest.mark.study)
        for name, seed, bits in [
            ("ur5", 700, 17), ("ur10", 700, 20), ("kinova", 700, 17), ("panda", 700, 20),
            ("tiago_arm", 700, 17),
        ]
    ],
)  # fmt: skip
def test_heavy_arms_reach_though_nobody_told_of_their_joints(name, seed, bits):
    """Rotors, springs and friction as usual, q̇ 5 ms and torques 2 ms late, and a camera."""
    result = run_scenario(
        recommended(
            Scenario(
                name,
                true={"object": {"length": 0.2, "mass": 0.5}, "drives": "usual"},
                sensor={
                    "noise": 5e-4, "rate": 60.0, "velocity_filter": 5e-3,
                    "q_quantum": 2.0 * np.pi / 2**bits,
                },
                loop={"actuator_delay": 2e-3},
                run={"start": "random", "duration": 9.0, "seed": seed},
            )
        )
    )  # fmt: skip
    run = result.run
    late = run.error_norm[run.t > 7.0]
    assert np.sqrt(np.mean(late**2)) < 3e-3
    assert (np.abs(run.v) < 1.1 * result.built.plant.robot.velocity_limits).all()
