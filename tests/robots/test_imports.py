"""What loading a robot imports, in an interpreter of its own."""

import subprocess
import sys

FIRST_CONTROLLER = """
import sys
import approxjac as aj
aj.SetpointController(aj.PositionTask(aj.load_robot("panda").with_object(0.1)))
HEAVY = {"scipy", "trimesh", "yourdfpy", "networkx", "shapely", "PIL", "matplotlib"}
print(*HEAVY & set(sys.modules))
"""


def test_a_first_controller_imports_neither_meshes_nor_scipy():
    command = [sys.executable, "-c", FIRST_CONTROLLER]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    assert answer.stdout.split() == []
