"""A law of your own: a spring, a damper and an integral, judged like the laws of the library.

You will see: the error of a Panda whose tool is unknown and heavy, the energy V that the law says
is its own, the force that its integral learns, and how fast errors die out near the target for
other integral gains: stable up to the dashed line, beyond which rollouts no longer converge.

You will learn: that `step` makes a law, and `lyapunov`, `learnt` and `parameters` the rest: V along
its runs, plots by name, `local_stability` by linearisation, rollouts and a report. A step that
never branches on a value is also compiled, run in lanes and written as C.

    python examples/18_a_law_of_your_own.py --out results/examples
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.codegen import compiled

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
(out := arguments.parse_args().out).mkdir(parents=True, exist_ok=True)


class SpringAndIntegral(aj.Controller):
    """F = -kp e - kd J v + f at the believed tip, and soft springs that draw joints to START.

    f integrates -ki e, and is held at its ends so that it cannot wind up.
    """

    def __init__(self, task, ki, kp=400.0, kd=40.0, most=40.0):
        super().__init__(task)
        self.ki, self.kp, self.kd, self.most = ki, kp, kd, most
        self.damping = np.array([8.0, 8.0, 8.0, 8.0, 1.0, 1.0, 0.5])
        self.parameters = {f"force along {axis}": "N" for axis in task.labels}
        self.model = aj.robots.Dynamics(task.robot)

    def begin(self, measurement):
        """Begin with f = 0."""
        return np.zeros(self.task.m)

    def advance(self, f, measurement, target, dt):
        """Return f after dt, and the torque."""
        _, q, v, x, _ = measurement
        e, J = self.task.error(x, target), self.task.jacobian(q, x)
        gravity = self.model.g(q).copy()
        force = f - self.kp * e - self.kd * J @ v
        torque = gravity + J.T @ force - 5.0 * (q - START) - self.damping * v
        after = np.clip(f - self.ki * dt * e, -self.most, self.most)
        return after, aj.Evaluation(torque, None, aj.Status.OK, e, J, gravity)

    def learnt(self, state):
        """Return all of the state: f."""
        return state

    def lyapunov(self, at):
        """Return V at an instant of a run, where at.M, at.e and at.v are true."""
        return 0.5 * at.v @ at.M @ at.v + 0.5 * self.kp * at.e @ at.e


START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
DT, KI = 2e-3, 600.0
arm = aj.load_robot("panda")
truth, belief = arm.with_object(0.15, 0.3, axis="x"), arm.with_object(0.0)
task, plant = aj.PositionTask(belief), aj.Plant(truth, actuator_delay=2e-3)
law = SpringAndIntegral(task, KI)
target = plant.sensor.value(START) + [0.1, -0.15, 0.1]
run = aj.simulate(plant, law, target, START, 6.0, dt=DT)
print(f"{law}\n{run}")
print(f"V from {run.V[0]:.3g} to {run.V[-1]:.3g} J, at most {run.V_dot.max():+.3g} W on the way")
print(aj.local_stability(plant, law, run.q[-1], dt=DT))
again = aj.simulate(plant, compiled(law), target, START, 6.0, dt=DT)
print(f"compiled, torques differ by {np.abs(again.tau - run.tau).max():.0e} N m at most")
print(aj.export_c(law, out / "18_own_law"))

errors = aj.Uncertainty(arm, object_length=(0.0, 0.15), object_mass=(0.0, 0.3), object_axis="x")
late = aj.Latency(period=DT, torque_delay=2e-3)
region = aj.JointBox.around(arm, START, 0.2)
study = aj.Study(SpringAndIntegral(task, KI), errors, region, latency=late, duration=8.0)
print(study.report(20, runs=8))

gains = np.linspace(250.0, 6000.0, 12)
rates = [
    aj.local_stability(plant, SpringAndIntegral(task, ki), run.q[-1], DT).decay_rate for ki in gains
]
low, high = gains[0], gains[-1]
while high - low > 20.0:  # by bisection: up to where it is stable
    middle = 0.5 * (low + high)
    stable = aj.local_stability(plant, SpringAndIntegral(task, middle), run.q[-1], DT).stable
    low, high = (middle, high) if stable else (low, middle)
shares = []
for ki in (0.5 * low, 1.5 * low):
    many = replace(study, controller=SpringAndIntegral(task, ki)).rollouts(6)
    shares.append(many.share)
    print(f"ki {ki:.0f} (stable up to {low:.0f}): {many.n_converged} of {many.n} runs converge")
print(f"they ran in: {many.setting.engine}")

figure, axes = view.new_figure(2, 2, title="A spring, a damper and an integral")
view.plot_error(run, axes[0])
with view.style():
    axes[1].semilogy(run.t, run.V, color=view.COLORS["true"])
    axes[1].set(xlabel="time [s]", ylabel="V [J]", title="The energy V of the law")
    axes[1].set_xlim(run.t[0], run.t[-1])
    axes[3].plot(gains, rates, "o-", color=view.COLORS["true"], label="at the target")
    axes[3].axvline(low, color=view.COLORS["neutral"], linestyle="--", label="largest stable ki")
    axes[3].set(xlabel="ki [N/(m s)]", ylabel="decay rate [1/s]", title="Stable up to which ki?")
    axes[3].set_xlim(0.0, 1.9 * low)
    for factor, share in zip((0.5, 1.5), shares, strict=True):
        text = f"{100.0 * share:.0f} % of\nrollouts arrive"
        axes[3].annotate(text, (factor * low, 0.1), ha="center", fontsize=8)
    view.legend_below(axes[3])
view.plot_parameters(run, ax=axes[2], title="The force that the law learns")
print(*view.save_figure(figure, out / "18_own_law"), sep="\n")
print(view.save_page(run, out / "18_own_law.html", "A spring, a damper and an integral"))
print(view.write_index(out))
