"""Time of a step in C, compiled by gcc -O2, beside the compiled step and the plain one in Python.

The step in C is timed in C, over recorded inputs, and all that a loop needs is in it: checks,
law, limits, state. All take turns.

    python tests/benchmarks/c_step.py
"""

import re
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from turns import medians, table

import approxjac as aj

COUNT, ROUNDS, TURNS = 500, 200, 7
MAIN = """
#include "controller.h"
#include <stdio.h>
#include <time.h>
static const struct {
    @p_measurement first, second, now;
    @p_target target;
} inputs[] = {
@inputs
};
int main(void)
{
    static @p_state states[@count];
    @p_answer answer;
    struct timespec a, b;
    double sum = 0.0;
    int i, k;
    for (i = 0; i < @count; ++i) {
        @p_init(&states[i], &inputs[i].first);
        @p_step(&states[i], &inputs[i].first, &inputs[i].target, 1e-3, &answer);
        @p_step(&states[i], &inputs[i].second, &inputs[i].target, 1e-3, &answer);
    }
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &a);
    for (k = 0; k < @rounds; ++k) {
        for (i = 0; i < @count; ++i) {
            @p_state next = states[i];
            @p_step(&next, &inputs[i].now, &inputs[i].target, 1e-3, &answer);
            sum += answer.torque[0];
        }
    }
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &b);
    printf("%.9g %g\\n", ((double)(b.tv_sec - a.tv_sec) + 1e-9 * (double)(b.tv_nsec - a.tv_nsec))
        / (@rounds * (double)@count), sum);
    return 0;
}
"""


def inputs_of(task, rng):
    """Three samples of slow motion each, not far from a target; the last is timed.

    The guard takes longer over a second sample, which nothing has confirmed yet.
    """
    found = []
    for _ in range(COUNT):
        q, v = task.robot.random_configuration(rng), rng.uniform(-0.5, 0.5, task.robot.nv)
        target = task.value(q) + 0.05 * rng.normal(size=task.n_x)
        motion = [(k * 1e-3, q + k * 1e-3 * v, v + k * 1e-4) for k in range(3)]
        found.append(([aj.Measurement(*at, task.value(at[1])) for at in motion], target))
    return found


def _braced(numbers):
    return f"{{{', '.join(float(each).hex() for each in numbers)}}}"


class InC:
    """The controller as a program of its own that tells its time."""

    def __init__(self, controller, inputs, folder):
        aj.export_c(controller, folder)
        rows = []
        for motion, target in inputs:
            samples = (
                f"{{{t!r}, {_braced(q)}, {_braced(v)}, {_braced(x)}, 0.0}}"
                for t, q, v, x, _ in motion
            )
            rows.append(f"{{{', '.join(samples)}, {{{_braced(target)}}}}}")
        words = {
            "inputs": ",\n".join(rows),
            "p": controller.task.robot.name,
            "rounds": ROUNDS,
            "count": COUNT,
        }
        text = re.sub(r"@(inputs|rounds|count|p)", lambda m: str(words[m[1]]), MAIN)
        (folder / "time.c").write_text(text, encoding="utf-8")
        strict = ["-O2", "-ffp-contract=off", "-Wall"]
        for command in (
            ["gcc", "-std=c99", *strict, "-c", "controller.c"],
            ["gcc", "-std=gnu99", *strict, "time.c", "controller.o", "-lm", "-o", "time"],
        ):
            subprocess.run(command, cwd=folder, check=True)
        sizes = subprocess.run(
            ["size", "controller.o"], cwd=folder, check=True, capture_output=True, text=True
        ).stdout
        self.folder, self.kilobytes = folder, int(sizes.splitlines()[1].split()[0]) / 1024.0

    def seconds(self):
        """Time of a step [s]."""
        run = subprocess.run([self.folder / "time"], check=True, capture_output=True, text=True)
        return float(run.stdout.split()[0])


def row(name, controller, law, rng, folder):
    """Name, times of a step [µs], shares, and size [kB]."""
    inputs = inputs_of(controller.task, rng)
    in_c = InC(controller, inputs, folder)
    in_python = []
    for (first, second, now), target in inputs:
        state = controller.initial_state(first)
        for each in (first, second):
            state = controller.step(state, each, target, 1e-3)[0]
        in_python.append((state, now, target))
    steps = {"plain": controller}
    if law is controller:
        steps["compiled"] = aj.codegen.compiled(law)
    calls = {
        kind: (lambda *arguments, step=each.step: step(*arguments, 1e-3))
        for kind, each in steps.items()
    }
    times = {kind: 1e6 * t for kind, t in medians(calls, in_python, TURNS).items()}
    c = 1e6 * float(np.median([in_c.seconds() for _ in range(TURNS)]))
    compiled = times.get("compiled")
    return [name, times["plain"], compiled, c, times["plain"] / c, in_c.kilobytes]


def main():
    arm = aj.load_robot("panda")
    task, rng = aj.PositionTask(arm), np.random.default_rng(0)
    effort = aj.Limits(effort=0.5 * arm.effort_limits)
    known, learnt = (
        aj.SetpointController(task),
        aj.SetpointController(task, gravity=aj.AdaptiveGravity(arm)),
    )
    rows = []
    for name, controller, law in (
        ("(6)", known, known),
        ("(6), half the torque", aj.TorqueLimited(known, effort), known),
        ("(28), (29)", learnt, learnt),
        ("(28), (29), half the torque", aj.TorqueLimited(learnt, effort), learnt),
    ):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(row(name, controller, law, rng, Path(folder)))
    heads = ["Panda, µs", "Python", "compiled", "C", "Python / C", "code, kB"]
    print(table(heads, rows))


if __name__ == "__main__":
    main()
