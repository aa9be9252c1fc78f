"""Scenarios that several tests start from."""

from approxjac.scenario import Scenario

HOME = (0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7)


def reach(robot="panda", **parts):
    """A reach at 500 Hz; further tables change it."""
    return Scenario(robot, loop={"dt": 0.002}).with_values(parts)


def camera(robot="panda", **parts):
    """A camera in the room that watches the tip of a tool nobody told of, without limits; tables
    change it."""
    return Scenario(
        robot,
        true={"object": {"length": 0.15, "mass": 0.3}},
        task={"kind": "image"},
        sensor={"noise": 0.5, "rate": 30.0, "delay": 0.03},
        controller={"gravity": "exact", "settling_time": 1.5, "unseen": 40.0, "limits": "none"},
        loop={"dt": 0.0025},
        run={"duration": 15.0},
    ).with_values(parts)
