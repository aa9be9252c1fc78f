"""What loading a robot and a first run import, in an interpreter of its own."""

import subprocess
import sys

FIRST_RUN = """
import sys
import approxjac as aj
arm = aj.load_robot("panda").with_object(0.1)
task = aj.PositionTask(arm)
law = aj.TorqueLimited(aj.SetpointController(task))
aj.simulate(aj.Plant(arm, task), law, duration=0.01, dt=1e-3, target=task.value(arm.neutral()))
HEAVY = {
    "scipy", "trimesh", "yourdfpy", "networkx", "shapely", "PIL", "matplotlib", "osqp",
    "qpsolvers", "mujoco", "llvmlite", "meshcat", "tornado", "tqdm", "IPython",
}
print(*HEAVY & set(sys.modules))
"""


def test_a_first_run_imports_neither_meshes_nor_scipy_nor_anything_else_that_is_heavy():
    command = [sys.executable, "-c", FIRST_RUN]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    assert answer.stdout.split() == []
