"""Programs as vectors of LLVM: one run a lane, as many lanes as the machine's vectors have."""

from __future__ import annotations

import ctypes
import re
import struct
from typing import Any

from approxjac.codegen.program import STEP, Program, statements
from approxjac.extras import package_of
from approxjac.validation import Array

_TEMPLATES = {
    "add": "fadd D {0}, {1}",
    "subtract": "fsub D {0}, {1}",
    "multiply": "fmul D {0}, {1}",
    "divide": "fdiv D {0}, {1}",
    "negative": "fneg D {0}",
    "absolute": "call D @llvm.fabs.N(D {0})",
    "sqrt": "call D @llvm.sqrt.N(D {0})",
    "floor": "call D @llvm.floor.N(D {0})",
    "power": "call D @power(D {0})",
    "less": "fcmp olt D {0}, {1}",
    "less_equal": "fcmp ole D {0}, {1}",
    "equal": "fcmp oeq D {0}, {1}",
    "and": "and B {0}, {1}",
    "or": "or B {0}, {1}",
    "not": "xor B {0}, TRUE",
    "select": "select B {0}, D {1}, D {2}",
}
_MODULE = """
declare D @llvm.fabs.N(D)
declare D @llvm.sqrt.N(D)
declare D @llvm.floor.N(D)
define internal D @power(D %a) alwaysinline {{
  %bits = bitcast D %a to I
  %moved = shl I %bits, SHIFT
  %power = bitcast I %moved to D
  ret D %power
}}
define void @run(ptr %kept, ptr %given, i64 %groups, i64 %first, i64 %last, i64 %every) {{
entry:
  br label %group
group:
  %g = phi i64 [ 0, %entry ], [ %g_next, %group_end ]
  %at = mul i64 %g, {rows}
  %s = getelementptr D, ptr %kept, i64 %at
  %from = mul i64 %g, {parameters}
  %p = getelementptr D, ptr %given, i64 %from
  br label %step
step:
  %k = phi i64 [ %first, %group ], [ %k_next, %step_end ]
  %k_next = add i64 %k, 1
  %number_0 = sitofp i64 %k to double
  %number_1 = insertelement D undef, double %number_0, i64 0
  %number = shufflevector D %number_1, D undef, ZERO
{slots}
{step}
  %left = urem i64 %k_next, %every
  %is_recorded = icmp eq i64 %left, 0
  br i1 %is_recorded, label %record, label %step_end
record:
{record}
  br label %step_end
step_end:
  %goes_on = icmp slt i64 %k_next, %last
  br i1 %goes_on, label %step, label %group_end
group_end:
  %g_next = add i64 %g, 1
  %has_more = icmp slt i64 %g_next, %groups
  br i1 %has_more, label %group, label %end
end:
  ret void
}}
"""


class LlvmLanes:
    """A program compiled for vectors of this machine.

    The bits are the same for any width: nothing is contracted or reordered.

    Args:
        program: The program.
        width: Runs a vector; by default those that fill one of this machine.
        cpu: The processor to compile for; this one by default.

    Raises:
        MissingPackageError: llvmlite is not installed.
    """

    def __init__(self, program: Program, width: int | None = None, features: str | None = None):
        llvm = package_of("fast", "llvmlite.binding")
        _initialize(llvm)
        if features is None:
            features = llvm.get_host_cpu_features().flatten()
        wide = "+avx512f" in features
        self.width = width or (8 if wide else 4)
        if wide:  # or LLVM takes halves of such vectors, at half of the speed
            features += ",-prefer-256-bit"
        target = llvm.Target.from_default_triple()
        machine = target.create_target_machine(
            cpu=llvm.get_host_cpu_name(), features=features, opt=2, jit=True
        )
        module = llvm.parse_assembly(_source(program, self.width))
        passes = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(1))
        passes.getModulePassManager().run(module, passes)
        self._engine = llvm.create_mcjit_compiler(module, machine)  # which the function lives in
        self._engine.finalize_object()
        pointer, number = ctypes.c_void_p, ctypes.c_int64
        self._run = ctypes.CFUNCTYPE(None, pointer, pointer, number, number, number, number)(
            self._engine.get_function_address("run")
        )

    def run(self, kept: Array, parameters: Array, first: int, steps: int, every: int) -> None:
        """Go on by some steps, in place: see `NumpyLanes.run`. Other threads go on meanwhile."""
        if steps > 0 and len(kept) > 0:
            self._run(
                kept.ctypes.data, parameters.ctypes.data, len(kept), first, first + steps, every
            )


def _initialize(llvm: Any) -> None:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()


def _source(program: Program, width: int) -> str:
    """Return a program in LLVM's language."""
    D = f"<{width} x double>"
    words = {
        "D": D,
        "B": f"<{width} x i1>",
        "I": f"<{width} x i64>",
        "N": f"v{width}f64",
        "TRUE": f"<{', '.join(['i1 true'] * width)}>",
        "ZERO": f"<{width} x i32> zeroinitializer",
        "SHIFT": f"<{', '.join(['i64 52'] * width)}>",
    }
    templates = {name: _filled(text, words) for name, text in _TEMPLATES.items()}
    slots = []
    for name, (at, size, steps) in program.rings.items():
        slots += [
            f"  %{name}.slot = urem i64 %k, {steps}",
            f"  %{name}.row = mul i64 %{name}.slot, {size}",
            f"  %{name}.place = add i64 %{name}.row, {at}",
            f"  %{name}.ring = getelementptr {D}, ptr %s, i64 %{name}.place",
        ]
    text = _filled(_MODULE, words).format(
        rows=program.n_rows,
        parameters=max(program.n_parameters, 1),
        slots="\n".join(slots),
        step="\n".join(_part(program, program.stepped, templates, D, width, "a")),
        record="\n".join(_part(program, program.recorded, templates, D, width, "b")),
    )
    return text


def _part(
    program: Program, values: Any, templates: Any, D: str, width: int, prefix: str
) -> list[str]:
    def constant(value: float) -> str:
        bits = struct.unpack("<Q", struct.pack("<d", value))[0]
        return f"<{', '.join([f'double 0x{bits:016X}'] * width)}>"

    aligned = "align 8"
    lines: list[str] = []

    def pointer(name: str, i: int) -> str:
        """Return a pointer to a row, for which lines may be needed before."""
        base, at = "%s", i
        if name in program.rows:
            at += program.rows[name][0]
        elif name in program.rings:
            base = f"%{name}.ring"
        else:
            base, at = "%p", at + program.parameters[name][0]
        variable = f"%{prefix}.{name}.{i}.{len(lines)}"
        lines.append(f"  {variable} = getelementptr {D}, ptr {base}, i64 {at}")
        return variable

    def of_input(name: str, i: int) -> str:
        if name == STEP:
            return f"bitcast {D} %number to {D}"
        return f"load {D}, ptr {pointer(name, i)}, {aligned}"

    wanted = [number for numbers in values.values() for number in numbers]

    computed, names = statements(
        program.graph,
        wanted,
        templates,
        lambda name, text, _: f"  {name} = {text}",
        f"%{prefix}",
        of_input,
        constant,
    )
    found = iter(names)
    lines += computed
    for name, numbers in values.items():
        for i in range(len(numbers)):
            lines.append(f"  store {D} {next(found)}, ptr {pointer(name, i)}, {aligned}")
    return lines


def _filled(text: str, words: dict[str, str]) -> str:
    """Return a text with its abbreviations, words in capitals, written out."""
    return re.sub(r"\b(D|B|I|N|TRUE|ZERO|SHIFT)\b", lambda found: words[found[0]], text)
