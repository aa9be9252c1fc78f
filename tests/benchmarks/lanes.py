"""Steps of the closed loop a second, of everything that can take them, in one process and one core.

A Panda with a tool that is truly longer and heavier, semi-implicit Euler at 1 ms: law (6) with the
believed gravity. All take turns; runs that are many differ in tool, start and target. JAX takes
part where it is installed (`pip install jax`, without a GPU).

    export OMP_NUM_THREADS=1 PYTHONPATH=tests/codegen
    taskset -c 0 python tests/benchmarks/lanes.py
"""

import functools
import time

import mujoco
import naive_laws as naive
import numpy as np
import pinocchio as pin
import turns
from mujoco import rollout
from numpy_lanes import NumpyLanes

import approxjac as aj
from approxjac.codegen.backends import numpy_function as by_numpy
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.backends.numpy_function import numpy_function
from approxjac.codegen.lanes import Lanes
from approxjac.codegen.trace.program import RECORDED, STEP, Block
from approxjac.robots import Dynamics
from approxjac.stability.rollouts.setting import RolloutSetting

DT, LANES, ROUNDS = 1e-3, 1024, 5
AVX2 = "+sse4.2,+avx,+avx2"


def study(learns, **late):
    """The loop: within a box of ±0.3 rad about a usual posture, so that few touch a stop.

    Sensors and motors are those of `late`, such as a `sensing`; else ideal.
    """
    arm = aj.load_robot("panda")
    errors = aj.Uncertainty(arm, object_length=(0.0, 0.2), object_mass=(0.0, 0.5), friction=0.1)
    task = errors.believed_task()
    gravity = aj.AdaptiveGravity(task.robot) if learns else None
    law = aj.SetpointController(task, gravity=gravity)
    q = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.5])
    region = aj.JointBox.around(task.robot, q, 0.3)
    whole = RolloutSetting(law, errors, region, None, 1.0, DT, 1e-3, 0, **late)
    starts = [whole.start(index) for index in range(LANES)]
    begun = [each.lane_start(law) for each in starts]
    return law, starts[0], begun, region


def in_lanes(engine, learns=False, integrator="semi_implicit_euler"):
    """A function of a number of steps, and how long it took to be compiled [s]."""
    law, first, begun, box = study(learns)
    lanes = Lanes(law, first.plant, begun, box, DT, 1000, 1e-3, integrator)
    start = time.process_time()
    compiled = engine(lanes.program)
    took = time.process_time() - start
    lanes.compiled = compiled
    kept, given = lanes.packed(begun)

    def run(steps):
        times = np.zeros((steps, lanes.program.n_times))
        times[::10, lanes.program.times[RECORDED][0]] = 1.0
        compiled.run(kept.copy(), given, Block(0, times, np.zeros((len(kept), steps, 0, 1))))
        return steps * LANES

    return run, took


def simulated(learns):
    law, begin, _, _ = study(learns)

    def run(steps):
        aj.simulate(
            begin.plant, law, begin.target, begin.q, steps * DT, dt=DT, record_every=steps * DT,
            computation=aj.simulation.Computation("semi_implicit_euler"),
        )  # fmt: skip
        return steps

    return run


def careful_loop():
    """The least that a loop in Python takes: the law as typed in, and Pinocchio, unchecked."""
    law, begin, _, _ = study(False)
    robot = law.task.robot
    truth, data = begin.plant.robot.model, begin.plant.robot.model.createData()
    frame = begin.plant.robot.frame_id(begin.plant.sensor.frame)
    J_of = naive.jacobian(robot, slice(0, 3))
    kp, kv, damping = law.diagonals
    gamma, g = law.saturation.gamma, Dynamics(robot).g
    B = begin.plant.friction

    def run(steps):
        q, v = begin.q, np.zeros(robot.nv)
        for _ in range(steps):
            pin.framesForwardKinematics(truth, data, q)
            e = data.oMf[frame].translation - begin.target
            J = J_of(q)
            tau = g(q) - damping * v - (kp * gamma * np.tanh(e / gamma) + kv * J.dot(v)).dot(J)
            v = v + DT * pin.aba(truth, data, q, v, tau - B * v)
            q = q + DT * v
        return steps

    return run


def mujoco_rollout():
    """MuJoCo's own threads-free rollout of the plant alone, under gravity's torque."""
    plant = aj.MujocoPlant(aj.load_robot("panda"))
    model = plant.mujoco_model
    data = mujoco.MjData(model)
    full = np.zeros((64, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))

    def run(steps):
        rollout.rollout(model, data, full, control=np.zeros((64, steps, model.nu)))
        return steps * 64

    return run


def in_jax():
    """The same operations as lanes, compiled by XLA: a function as above, or None without JAX."""
    try:
        import jax
    except ImportError:
        return None, None
    jax.config.update("jax_enable_x64", True)
    law, first, begun, box = study(False)
    lanes = Lanes(law, first.plant, begun, box, DT, 1000, 1e-3)
    program = lanes.program
    lanes.compiled = NumpyLanes(program)
    numbers = [number for name in program.stepped for number in program.stepped[name]]
    ours = by_numpy._OPERATIONS
    own = {name: getattr(jax.numpy, ours[name].__name__) for name in {*ours} - {"power"}}
    own["power"] = lambda a: (a.view(jax.numpy.int64) << 52).view(jax.numpy.float64)
    ours |= own
    function = numpy_function(program.graph, numbers)
    kept, given = (np.moveaxis(a, 1, 0).reshape(a.shape[1], -1) for a in lanes.packed(begun))
    places = [program.rows[name] for name in program.stepped]
    rows = np.concatenate([np.arange(at, at + size) for at, size in places])
    fixed = {name: given[at : at + size] for name, (at, size) in program.parameters.items()}

    def step(k, state):
        values = {name: state[at : at + size] for name, (at, size) in program.rows.items()}
        computed = function(**values, **fixed, **{STEP: [k.astype(float)], RECORDED: [0.0]})
        computed = [jax.numpy.broadcast_to(row, state.shape[1:]) for row in computed]
        return state.at[rows].set(jax.numpy.stack(computed))

    many = jax.jit(lambda state, steps: jax.lax.fori_loop(0, steps, step, state))

    def run(steps):
        many(kept, steps).block_until_ready()
        return steps * LANES

    start = time.process_time()
    run(1)
    return run, time.process_time() - start


def measured():
    """Steps a second of each, the median of rounds in which all take turns."""
    runs, built = {}, {}
    runs["`simulate`"] = simulated(False), 500
    runs["`simulate`, learnt gravity"] = simulated(True), 300
    runs["a careful loop in Python"] = careful_loop(), 1000
    runs["`mujoco.rollout`, the plant alone"] = mujoco_rollout(), 200
    for title, make, options, steps in (
        ("NumPy, 1024 runs at once", NumpyLanes, {}, 3),
        ("lanes, AVX2", functools.partial(LlvmLanes, width=4, features=AVX2), {}, 300),
        ("lanes, this machine", LlvmLanes, {}, 300),
        ("lanes, RK4", LlvmLanes, {"integrator": "rk4"}, 100),
        ("lanes, learnt gravity", LlvmLanes, {"learns": True}, 300),
    ):
        run, built[title] = in_lanes(make, **options)
        runs[title] = run, steps
    run, took = in_jax()
    if run is not None:
        title = "JAX, 1024 runs at once"
        runs[title], built[title] = (run, 3), took
    times = {name: [] for name in runs}
    for _ in range(ROUNDS):
        for name, (run, steps) in runs.items():
            times[name].append(_timed(run, steps))
    return {name: float(np.median(each)) for name, each in times.items()}, built


def _timed(run, steps):
    start = time.process_time()
    done = run(steps)
    return (time.process_time() - start) / done


def table():
    """Markdown."""
    found, built = measured()
    slow = found["`simulate`"]
    rows = [
        (name, f"{1.0 / each:,.0f}", 1e6 * each, slow / each, built.get(name))
        for name, each in found.items()
    ]
    return turns.table(("on one core", "steps/s", "µs", "× `simulate`", "to compile, s"), rows)


if __name__ == "__main__":
    print(table())
