"""A saturation of one's own, compiled, written as C and tried a thousand times.

You will see: s(e) = e/(1 + (e/γ)²)^½ beside the library's tanh, on a Panda with an unknown tool.
Far from the target both pull with the same force; in between the own one is the softer one. Both
as machine code, and the share of 1000 other tools, starts and targets that arrive.

You will learn: the six parts of a saturation, of which the controller checks that they belong
together.

    python examples/20_own_saturation.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.codegen import compiled
from approxjac.law import Tanh

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
(out := arguments.parse_args().out).mkdir(parents=True, exist_ok=True)


class Soft:
    """s(e) = e/(1 + (e/γ)²)^½, the slope of γ²((1 + (e/γ)²)^½ − 1)."""

    c_bar = 0.5

    def __init__(self, gamma):
        self.gamma = gamma

    def _grown(self, e):
        return np.sqrt(1.0 + (e / self.gamma) ** 2)

    def s(self, e):
        """Return s(e)."""
        return e / self._grown(e)

    def S(self, e):
        """Return the potential, whose slope is s."""
        return e**2 / (1.0 + self._grown(e))  # which does not cancel near 0

    def ds(self, e):
        """Return the slope of s."""
        return self._grown(e) ** -3.0


arm, gamma = aj.load_robot("panda"), 0.05
errors = aj.Uncertainty(arm, object_length=(0.0, 0.2), object_mass=(0.0, 0.5))
start = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
plant = aj.Plant(arm.with_object(0.15, 0.4, axis="x"))
target = plant.sensor.value(start) + [0.10, -0.20, 0.15]
region = aj.JointBox.around(arm, start, 0.3)
options = {
    "duration": 4.0,
    "dt": 2e-3,
    "computation": aj.simulation.Computation("semi_implicit_euler"),
}

figure, (left, right) = view.new_figure(2, title="A saturation of one's own")
for name, saturation in (("tanh", Tanh(gamma)), ("own", Soft(gamma))):
    law = aj.SetpointController(
        errors.believed_task(), saturation=saturation, gravity=aj.AdaptiveGravity(arm)
    )
    run = aj.simulate(plant, compiled(law), target, start, **options)
    plain = aj.simulate(plant, law, target, start, **options)
    many = aj.Study(law, errors, region, duration=4.0).rollouts(1000)
    print(
        f"{name}: {1e3 * run.error_norm[-1]:.2f} mm away, machine code and Python differ by "
        f"{np.abs(run.tau - plain.tau).max():.0e} N m; {many.share:.1%} of 1000 runs arrive, in "
        f"{many.setting.engine}"
    )
    with view.style():
        e = np.linspace(0.0, 4.0 * gamma, 200)
        left.plot(e, saturation.s(e), label=name)
        right.semilogy(run.t, run.error_norm, label=name)
print(aj.export_c(law, out / "20_own_saturation"))
with view.style():
    left.set(xlabel="e [m]", ylabel="s(e) [m]", title="Saturations")
    right.set(xlabel="time [s]", ylabel="error [m]", title="Error of a reach")
    view.legend_below(left)
    view.legend_below(right)
print(*view.save_figure(figure, out / "20_own_saturation"), sep="\n")
print(
    view.save_page(
        run, out / "20_own_saturation.html", "A saturation of one's own: e/(1 + (e/γ)²)^½"
    )
)
print(view.write_index(out))
