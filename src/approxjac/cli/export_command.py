"""`approxjac export`: a scenario → its controller as C."""

from pathlib import Path

from approxjac.scenario import Scenario


def export(
    scenario: Scenario, effort_only: bool = False, folder: Path = Path("results/export")
) -> int:
    """Write the controller of a scenario as plain C99, with a self-test.

    Example: approxjac export panda --believed-length 0.1 --effort-only --folder controller

    Exit code 0; 2 where the controller is not covered, with the reason.

    Args:
        scenario: The scenario; what is true of it has no part in the controller.
        effort_only: Keep the limits of torques, and leave those of speeds and positions out: they
            are the robot's own to keep then, and the code is a tenth as long.
        folder: Folder for controller.h, controller.c, selftest.c and CMakeLists.txt.
    """
    from approxjac.codegen import export_c
    from approxjac.scenario import build_scenario

    built = build_scenario(scenario, effort_only=effort_only)
    path = export_c(built.controller, folder)  # it refuses others
    print(built.law)
    print(f"\nThe controller is in {path}; {path / 'controller.h'} says how to call it")
    print(f"Try it: cmake -B {path / 'build'} {path} && cmake --build {path / 'build'}")
    print(f"        ctest --test-dir {path / 'build'}")
    return 0
