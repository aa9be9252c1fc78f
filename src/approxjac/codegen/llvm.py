"""Programs as vectors of LLVM: one run a lane, as many lanes as the machine's vectors have."""

from __future__ import annotations

import ctypes
import functools
import re
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from approxjac.codegen.graph import Number, Scalar
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
_DECLARED = """
declare D @llvm.fabs.N(D)
declare D @llvm.sqrt.N(D)
declare D @llvm.floor.N(D)
define internal D @power(D %a) alwaysinline {
  %bits = bitcast D %a to I
  %moved = shl I %bits, SHIFT
  %power = bitcast I %moved to D
  ret D %power
}
"""
# from one step up to another, or to the first unusual one
_GO = """
define i64 @go(ptr %s, ptr %p, i64 %first, i64 %last, i64 %end_of_all, i64 %every) {{
entry:
  br label %step
step:
  %k = phi i64 [ %first, %entry ], [ %k_next, %step_end ]
  %k_next = add i64 %k, 1
  %number_0 = sitofp i64 %k to double
  %number_1 = insertelement D undef, double %number_0, i64 0
  %number = shufflevector D %number_1, D undef, ZERO
{step}
  %left = urem i64 %k, %every
  %is_due = icmp eq i64 %left, 0
  %is_last = icmp eq i64 %k, %end_of_all
  %is_recorded = or i1 %is_due, %is_last
  br i1 %is_recorded, label %record, label %step_end
record:
{record}
  br label %step_end
step_end:
{stores}
  %goes_on = icmp sle i64 %k_next, %last
  br i1 %goes_on, label %step, label %end
end:
  ret i64 %k_next
unusual:
  ret i64 %k
}}
"""
_UNLESS_UNUSUAL = """  %any = bitcast B {condition} to i{width}
  %is_unusual = icmp ne i{width} %any, 0
  br i1 %is_unusual, label %unusual, label %usual
usual:"""
# all groups, each from where it is; unusual steps are left to %complete, or to who has one
_RUN = """
define void @run(ptr %kept, ptr %given, ptr %reached, i64 %groups, i64 %last, i64 %every,
                 ptr %complete) {{
entry:
  br label %group
group:
  %g = phi i64 [ 0, %entry ], [ %g_next, %group_end ]
  %at = mul i64 %g, {rows}
  %s = getelementptr D, ptr %kept, i64 %at
  %from = mul i64 %g, {parameters}
  %p = getelementptr D, ptr %given, i64 %from
  %place = getelementptr i64, ptr %reached, i64 %g
  %first = load i64, ptr %place
  %begins = icmp sle i64 %first, %last
  br i1 %begins, label %usual, label %group_end
usual:
  %k = phi i64 [ %first, %group ], [ %k_complete, %unusual ]
  %k_usual = call i64 @go(ptr %s, ptr %p, i64 %k, i64 %last, i64 %last, i64 %every)
  %ends = icmp sgt i64 %k_usual, %last
  %has_none = icmp eq ptr %complete, null
  %leaves = or i1 %ends, %has_none
  br i1 %leaves, label %left, label %unusual
unusual:
  %soon = add i64 %k_usual, {soon}
  %is_soon = icmp slt i64 %soon, %last
  %stop = select i1 %is_soon, i64 %soon, i64 %last
  %k_complete = call i64 %complete(ptr %s, ptr %p, i64 %k_usual, i64 %stop, i64 %last, i64 %every)
  %ends_here = icmp sgt i64 %k_complete, %last
  br i1 %ends_here, label %left, label %usual
left:
  %k_left = phi i64 [ %k_usual, %usual ], [ %k_complete, %unusual ]
  store i64 %k_left, ptr %place
  br label %group_end
group_end:
  %g_next = add i64 %g, 1
  %has_more = icmp slt i64 %g_next, %groups
  br i1 %has_more, label %group, label %end
end:
  ret void
}}
"""
_WIDE = "+avx512f"
_SOON = 16  # steps, after which the usual ones are tried again


class LlvmLanes:
    """A program compiled for vectors of this machine.

    The bits are the same for any width and any machine: nothing is contracted or reordered. Unusual
    steps are compiled when the first one comes.

    Args:
        program: The program.
        width: Runs a vector; by default those that fill one of this machine.
        features: Of the processor to compile for; those of this one by default.

    Raises:
        MissingPackageError: llvmlite is not installed.
    """

    def __init__(
        self, program: Program, width: int | None = None, features: str | None = None
    ) -> None:
        self._program = program
        llvm = package_of("fast", "llvmlite.binding")
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        self._features = features or llvm.get_host_cpu_features().flatten()
        self.width = width or (8 if _WIDE in self._features else 4)
        self._usual = _compiled(self._features, _usual_source(program, self.width))
        pointer, number = ctypes.c_void_p, ctypes.c_int64
        arguments = (pointer, pointer, pointer, number, number, number, pointer)
        self._run = ctypes.CFUNCTYPE(None, *arguments)(self._usual.get_function_address("run"))

    @functools.cached_property
    def _complete(self) -> Any:
        return _compiled(self._features, _complete_source(self._program, self.width))

    def run(self, kept: Array, parameters: Array, last: int, every: int) -> None:
        """Take all steps, in place: see `NumpyLanes.run`. Other threads go on meanwhile."""
        reached = np.zeros(len(kept), dtype=np.int64)
        for complete in (lambda: None, lambda: self._complete.get_function_address("go")):
            if reached.min(initial=last + 1) <= last:
                self._run(
                    kept.ctypes.data, parameters.ctypes.data, reached.ctypes.data, len(kept), last,
                    every, complete(),
                )  # fmt: skip


def _compiled(features: str, source: str) -> Any:
    """Return LLVM's engine, in which the functions of a source live."""
    llvm = package_of("fast", "llvmlite.binding")
    if _WIDE in features:  # or LLVM takes two halves of each vector
        features += ",-prefer-256-bit"
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features, opt=2, jit=True
    )
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(source), machine)
    engine.finalize_object()
    return engine


def _usual_source(program: Program, width: int) -> str:
    run = _RUN.format(rows=program.n_rows, parameters=max(program.n_parameters, 1), soon=_SOON)
    return _source(program, width, program.usual, program.unusual) + _filled(run, width)


def _complete_source(program: Program, width: int) -> str:
    return _source(program, width, program.complete, False)


def _source(
    program: Program, width: int, step: Mapping[str, list[Number]], unusual: Scalar | bool
) -> str:
    """Return the steps of a program, up to the first unusual one."""
    pointers: list[str] = []
    names: dict[int, str] = {}

    def place(name: str, i: int) -> str:
        """Return a pointer to a row."""
        base, at = "%s", i
        if name in program.rows:
            at += program.rows[name][0]
        elif name in program.rings:
            base = f"%{name}.ring"
        else:
            base, at = "%p", at + program.parameters[name][0]
        pointer = f"%pointer{len(pointers)}"
        pointers.append(f"  {pointer} = getelementptr D, ptr {base}, i64 {at}")
        return pointer

    def of_input(name: str, i: int) -> str:
        return "bitcast D %number to D" if name == STEP else f"load D, ptr {place(name, i)}, align 8"

    def of_constant(value: float) -> str:
        (bits,) = struct.unpack("<Q", struct.pack("<d", value))
        return f"<{', '.join([f'double 0x{bits:016X}'] * width)}>"

    def lines(wanted: list[Number]) -> tuple[list[str], list[str]]:
        return statements(
            program.graph, wanted, _TEMPLATES, lambda name, text, _: f"  {name} = {text}", "%v",
            of_input, of_constant, names,
        )  # fmt: skip

    def stores(values: Mapping[str, list[Number]], found: list[str]) -> list[str]:
        places = [(name, i) for name, numbers in values.items() for i in range(len(numbers))]
        return [
            f"  store D {value}, ptr {place(*at)}, align 8"
            for at, value in zip(places, found, strict=True)
        ]

    def numbers_of(values: Mapping[str, list[Number]]) -> list[Number]:
        return [number for numbers in values.values() for number in numbers]

    wanted = numbers_of(step)
    computed, after = lines([*wanted, unusual] if isinstance(unusual, Scalar) else wanted)
    if isinstance(unusual, Scalar):
        computed.append(_UNLESS_UNUSUAL.format(condition=after.pop(), width=width))
    recorded, kept = lines(numbers_of(program.recorded))
    recorded += stores(program.recorded, kept)
    stored = stores(step, after)
    for name, (at, size, steps) in program.rings.items():
        pointers[:0] = [
            f"  %{name}.slot = urem i64 %k, {steps}",
            f"  %{name}.row = mul i64 %{name}.slot, {size}",
            f"  %{name}.place = add i64 %{name}.row, {at}",
            f"  %{name}.ring = getelementptr D, ptr %s, i64 %{name}.place",
        ]
    go = _GO.format(
        step="\n".join(pointers + computed), record="\n".join(recorded), stores="\n".join(stored)
    )
    return _filled(_DECLARED + go, width)


def _filled(text: str, width: int) -> str:
    """Return a text with its types, words in capitals, written out."""
    words = {
        "D": f"<{width} x double>",
        "B": f"<{width} x i1>",
        "I": f"<{width} x i64>",
        "N": f"v{width}f64",
        "TRUE": f"<{', '.join(['i1 true'] * width)}>",
        "ZERO": f"<{width} x i32> zeroinitializer",
        "SHIFT": f"<{', '.join(['i64 52'] * width)}>",
    }
    return re.sub(r"\b(D|B|I|N|TRUE|ZERO|SHIFT)\b", lambda found: words[found[0]], text)
