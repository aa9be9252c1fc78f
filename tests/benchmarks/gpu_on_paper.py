"""The closed loop of lanes as a CUDA kernel, compiled but not run: registers, spills, instructions.

What bounds it on a GPU: operations of one step against what the machine rounds in double precision.
Needs nvcc; no GPU.

    python tests/benchmarks/gpu_on_paper.py
"""

import collections
import re
import subprocess
import tempfile
from itertools import chain
from pathlib import Path

import lanes
import turns

from approxjac.codegen.backends import c99
from approxjac.codegen.backends.numpy_source import NumpyLanes
from approxjac.codegen.lanes import Lanes
from approxjac.codegen.trace.program import STEP, Writer

# Additions, or products, in double precision a second, not fused: half of what data sheets call
# FP64 (a fused multiplication and addition counts twice there).
MACHINES = {"RTX 4090": ("sm_89", 0.65e12), "A100": ("sm_80", 4.9e12), "H100 SXM": ("sm_90", 17e12)}

KERNEL = """
__device__ static double power_of_two(double n)
{
    return __longlong_as_double((long long)__double_as_longlong(n) << 52);
}
extern "C" __global__ void many(double *kept, const double *fixed, int runs, int steps)
{
    const int run = blockIdx.x * blockDim.x + threadIdx.x;
    if (run >= runs) return;
    double state[@states], given[@parameters];
    for (int i = 0; i < @states; ++i) state[i] = kept[i * runs + run];
    for (int i = 0; i < @parameters; ++i) given[i] = fixed[i * runs + run];
    for (int k = 0; k < steps; ++k) {
@lines
    }
    for (int i = 0; i < @states; ++i) kept[i * runs + run] = state[i];
}
"""


def kernel(learns):
    """The source of the kernel, and how many of each operation a step has, rare blocks included."""
    law, first, begun, box = lanes.study(learns)
    loop = Lanes(law, first.plant, begun, box, lanes.DT, 1000, 1e-3)
    loop.compiled = NumpyLanes(loop.program)
    program, (kept, given) = loop.program, loop.packed(begun)
    rows = {**program.rows, **program.parameters}

    def read(name, i):
        if name == STEP:
            return "(double)k"
        return f"{'state' if name in program.rows else 'given'}[{rows[name][0] + i}]"

    language = c99.LANGUAGE._replace(read=read)
    wanted = list(chain(*program.stepped.values()))
    lines, names = Writer(program.graph, language).lines(wanted)
    written = [program.rows[name] for name in program.stepped]
    at = [row for first, size in written for row in range(first, first + size)]
    lines += [f"    state[{row}] = {name};" for row, name in zip(at, names, strict=True)]
    source = KERNEL.replace("@states", str(kept.shape[1])).replace("@lines", "\n".join(lines))
    nodes = program.graph.nodes
    counts = collections.Counter(nodes[i].operation for i in program.graph.needed(wanted))
    return source.replace("@parameters", str(given.shape[1])), counts


def compiled(source, machine):
    """Registers of a thread and bytes that it spills."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "many.cu"
        file.write_text(source)
        options = ["-O3", "-fmad=false", f"-arch={machine}", "-cubin", "-Xptxas", "-v"]
        told = subprocess.run(
            ["nvcc", *options, "-o", file.with_suffix(".cubin"), file],
            check=True, capture_output=True, text=True,
        ).stderr  # fmt: skip
    registers = int(re.search(r"Used (\d+) registers", told)[1])
    return registers, sum(map(int, re.findall(r"(\d+) bytes spill", told)))


def main():
    """Print a table."""
    rows = []
    for title, learns in (("law (6)", False), ("learnt gravity", True)):
        source, counts = kernel(learns)
        rounded = sum(counts[name] for name in ("add", "subtract", "multiply"))
        slow = counts["divide"] + counts["sqrt"]
        for machine, (name, rate) in MACHINES.items():
            registers, spilled = compiled(source, name)
            most = rate / (rounded + 10 * slow)
            rows.append((title, machine, rounded, slow, registers, spilled, f"{most / 1e6:.0f}"))
    heads = ("loop", "GPU", "+ − ×", "÷ √", "registers", "bytes spilled", "10⁶ steps/s at most")
    print(turns.table(heads, rows))


if __name__ == "__main__":
    main()
