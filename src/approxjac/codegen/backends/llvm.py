"""Programs as vectors of LLVM: one run per lane of the machine's vectors."""

import ctypes
import re
import struct
from collections.abc import Callable
from itertools import chain, count
from string import Template

import numpy as np

from approxjac.codegen.backends.machine_code import MachineCode
from approxjac.codegen.backends.templates import template
from approxjac.codegen.trace.program import STEP, Block, Going, Language, Program, Rows, Writer
from approxjac.codegen.trace.symbols import FAR, Passes
from approxjac.errors import package_of
from approxjac.validation import Array

_TEMPLATES = {
    "add": "fadd $D {0}, {1}",
    "subtract": "fsub $D {0}, {1}",
    "multiply": "fmul $D {0}, {1}",
    "divide": "fdiv $D {0}, {1}",
    "negative": "fneg $D {0}",
    "absolute": "call $D @llvm.fabs.$N($D {0})",
    "sqrt": "call $D @llvm.sqrt.$N($D {0})",
    "far": "fadd $D {0}, $FAR",
    "power": "call $D @power($D {0})",
    "less": "fcmp olt $D {0}, {1}",
    "less_equal": "fcmp ole $D {0}, {1}",
    "equal": "fcmp oeq $D {0}, {1}",
    "and": "and $B {0}, {1}",
    "or": "or $B {0}, {1}",
    "not": "xor $B {0}, $TRUE",
    "select": "select $B {0}, $D {1}, $D {2}",
}
_OF_ONE = (  # vectors of one number, as numbers, of which LLVM makes vectors of its own
    (r"insertelement <1 x double> undef, (double \S+), i64 0", r"bitcast \1 to double"),
    (r"shufflevector <1 x double> (\S+), .*", r"bitcast double \1 to double"),
    (r"<(?:double|i1|i64) (\S+)>", r"\1"),
    (r"<1 x (double|i1|i64)>", r"\1"),
    (r"\bv1f64\b", "f64"),
)
_WIDE = "+avx512f"
_PART = 2000  # operations between branches, as LLVM takes long to find registers in long blocks


class LlvmLanes:
    """A program compiled for vectors of this machine.

    The bits are the same for any width and any machine: nothing is contracted or reordered.

    Raises:
        MissingPackageError: llvmlite is not installed.
    """

    def __init__(
        self,
        program: Program,
        width: int | None = None,  # runs per vector; by default the width of this machine's vectors
        # features of the processor to compile for; by default this one's
        features: str | None = None,
        effort: int = 1,  # optimization level of LLVM, from 0 to 3
    ) -> None:
        llvm = package_of("fast", "llvmlite.binding")
        features = features or llvm.get_host_cpu_features().flatten()
        self.width = width or (8 if _WIDE in features else 4)
        if _WIDE in features:  # or LLVM takes two halves of each vector
            features += ",-prefer-256-bit"
        self._code = MachineCode.of(_source(program, self.width), features, effort)
        # one argument, the address of all: ctypes takes long for each
        self._run = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(self._code.address)

    def run(self, kept: Array, parameters: Array, block: Block | None = None) -> None:
        """Carry out steps, in place, without the interpreter's lock.

        Args:
            kept: Memory of the runs, shape (groups, rows, width).
            parameters: Constants of the runs, shape (groups, parameters, width).
            block: The steps to take; by default one.
        """
        first, times, draws = block or Block.plain()
        if len(kept):
            arrays = (each.ctypes.data for each in (kept, parameters, times, draws))
            given = np.array([*arrays, len(kept), first, first + len(times)])
            self._run(given.ctypes.data)

    def bound(self, kept: Array, parameters: Array) -> Callable[[], None]:
        """Return a function that takes one step of these arrays, in place."""
        given = np.array([kept.ctypes.data, parameters.ctypes.data, 0, 0, 1, 0, 1])
        run, at = self._run, given.ctypes.data

        def step(_: object = (self, kept, parameters, given)) -> None:  # which have to stay
            run(at)

        return step


def packed(columns: Array, width: int) -> Array:
    """Return rows of runs (N, rows) as vectors (groups, rows, width); the last one fills the rest.

    `unpacked` is the way back.
    """
    n, rows = columns.shape
    groups = -(-n // width)
    filled = columns[np.minimum(np.arange(groups * width), n - 1)]
    return np.array(filled.reshape(groups, width, rows).swapaxes(1, 2), order="C")


def unpacked(vectors: Array, n: int) -> Array:
    """Return the rows of n runs (n, rows) in vectors (groups, rows, width)."""
    return vectors.swapaxes(1, 2).reshape(-1, vectors.shape[1])[:n]


def _rare(
    label: str, condition: str, lines: list[str], results: list[tuple[str, str, str]]
) -> list[str]:
    return [
        f"  %any{label} = bitcast $B {condition} to $FLAGS",
        f"  %is{label} = icmp ne $FLAGS %any{label}, 0",
        f"  br label %before{label}",
        f"before{label}:",
        f"  br i1 %is{label}, label %rare{label}, label %after{label}",
        f"rare{label}:",
        *lines,
        f"  br label %end{label}",
        f"end{label}:",
        *(f"  {name}.rare = select $B {condition}, $D {a}, $D {b}" for name, a, b in results),
        f"  br label %after{label}",
        f"after{label}:",
        *(
            f"  {name} = phi $D [ {name}.rare, %end{label} ], [ {b}, %before{label} ]"
            for name, _, b in results
        ),
    ]


def _spread(name: str, number: str) -> list[str]:
    """Return the lines that make a number of all runs a vector."""
    return [
        f"  {name}.one = insertelement $D undef, double {number}, i64 0",
        f"  {name} = shufflevector $D {name}.one, $D undef, $ZERO",
    ]


def _number(name: str, i: str) -> list[str]:
    return [f"  {name}.same = sitofp i64 %{i} to double", *_spread(name, f"{name}.same")]


def _source(program: Program, width: int) -> str:
    pointers: list[str] = []
    allocated: list[str] = []
    constants: dict[str, str] = {}
    written, operations = count(), count(1)

    def assigned(name: str, text: str, _: bool) -> str:
        """Return the line of an operation, now and then at the beginning of a block."""
        line, n = f"  {name} = {text}", next(operations)
        if n % _PART:
            return line
        goes_on = f"  %goes{n} = icmp sge i64 %i, 0\n  br i1 %goes{n}, label %part{n}, label %end"
        return f"{goes_on}\npart{n}:\n{line}"

    def pointer(base: str, at: int, kind: str = "$D") -> str:
        """Return a pointer to a row."""
        name = f"%pointer{len(pointers)}"
        pointers.append(f"  {name} = getelementptr {kind}, ptr {base}, i64 {at}")
        return name

    def time(name: str, i: int) -> str:
        """Return a number that is the same in all runs."""
        at = pointer("%t", program.times[name][0] + i, "double")
        pointers.append(f"  {at}.time = load double, ptr {at}, align 8")
        return f"{at}.time"

    def place(name: str, i: int, way: str) -> str:
        """Return a pointer to a row, to read from it or to write to it."""
        if name in program.histories:
            return pointer(f"%{name}.{way}", i)
        places = {"%s": program.rows, "%p": program.parameters, "%d": program.draws}
        base = next(base for base, names in places.items() if name in names)
        return pointer(base, places[base][name][0] + i)

    def read(name: str, i: int) -> str:
        if name == STEP:
            return "bitcast $D %number to $D"
        if name not in program.times:
            return f"load $D, ptr {place(name, i, 'from')}, align 8"
        number = time(name, i)
        pointers.append(f"  {number}.one = insertelement $D undef, double {number}, i64 0")
        return f"shufflevector $D {number}.one, $D undef, $ZERO"

    for name, (start, size) in program.histories.items():
        for way in ("from", "to"):
            at = f"%{name}.{way}"
            pointers += [
                f"  {at}.number = fptosi double {time(f'{name}.{way}', 0)} to i64",
                f"  {at}.of = mul i64 {at}.number, {size}",
                f"  {at}.row = add i64 {at}.of, {start}",
                f"  {at} = getelementptr $D, ptr %s, i64 {at}.row",
            ]

    def constant(value: float) -> str:
        (bits,) = struct.unpack("<Q", struct.pack("<d", value))
        return f"<{', '.join([f'double 0x{bits:016X}'] * width)}>"

    def table(name: str, numbers: list[str], is_constant: bool) -> list[str]:
        if is_constant:  # of one lane, as they are the same in all
            ones = ", ".join(each[1:-1].split(", ")[0] for each in numbers)
            constants[name] = f"@{name} = internal constant [{len(numbers)} x double] [{ones}]"
            return []
        allocated.append(f"  %{name} = alloca $D, i64 {len(numbers)}, align 8")
        return [line for i, each in enumerate(numbers) for line in stored(f"%{name}", i, each)]

    def stored(array: str, i: int | str, number: str) -> list[str]:
        """Return the lines that write a number to a place of an array."""
        at = f"%to{next(written)}"
        return [
            f"  {at} = getelementptr $D, ptr {array}, i64 {i}",
            f"  store $D {number}, ptr {at}, align 8",
        ]

    def loop(label: str, loop: Passes, lines: list[str], going: Going, rows: Rows) -> list[str]:
        s, y, i = f"%s{label}", f"%y{label}", f"%i{label}"
        for name, size in ((s, loop.n), (y, loop.times * loop.m)):
            allocated.append(f"  {name} = alloca $D, i64 {size}, align 8")
        collected = [
            line
            for at, each in rows
            for line in (f"  {i}.at{at} = add i64 {i}.row, {at}", *stored(y, f"{i}.at{at}", each))
        ]
        return [
            *(line for at, start, _ in going for line in stored(s, at, start)),
            f"  br label %enter{label}",
            f"enter{label}:",
            f"  br label %loop{label}",
            f"loop{label}:",
            f"  {i} = phi i64 [ 0, %enter{label} ], [ {i}.next, %latch{label} ]",
            *lines,
            f"  br label %latch{label}",
            f"latch{label}:",
            *(line for at, _, after in going for line in stored(s, at, after)),
            f"  {i}.row = mul i64 {i}, {loop.m}",
            *collected,
            f"  {i}.next = add i64 {i}, 1",
            f"  {i}.more = icmp slt i64 {i}.next, {loop.times}",
            f"  br i1 {i}.more, label %loop{label}, label %done{label}",
            f"done{label}:",
        ]

    def taken(name: str, array: str, i: str, apart: int, first: int) -> list[str]:
        base, kind = (f"@{array}", "double") if array in constants else (f"%{array}", "$D")
        read = [
            f"  {name}.of = mul i64 %{i}, {apart}",
            f"  {name}.at = add i64 {name}.of, {first}",
            f"  {name}.from = getelementptr {kind}, ptr {base}, i64 {name}.at",
        ]
        if kind == "$D":
            return [*read, f"  {name} = load $D, ptr {name}.from, align 8"]
        same = f"  {name}.same = load double, ptr {name}.from, align 8"
        return [*read, same, *_spread(name, f"{name}.same")]

    places = [(name, i) for name, numbers in program.stepped.items() for i in range(len(numbers))]

    def kept(i: int, value: str) -> str:
        """Return the line that writes a number to its place."""
        return f"  store $D {value}, ptr {place(*places[i], 'to')}, align 8"

    def changed(i: int, name: str, value: str, condition: str, keeps: str | None) -> list[str]:
        was, new = f"{name}.was", f"{name}.new"
        lines = [
            f"  {was} = load $D, ptr {place(*places[i], 'from')}, align 8",
            f"  {new} = select $B {condition}, $D {value}, $D {was}",
        ]
        if keeps is None:
            return [*lines, kept(i, new)]
        return [*lines, f"  {name} = select $B {keeps}, $D {was}, $D {new}", kept(i, name)]

    language = Language(
        templates=_TEMPLATES,
        variable="%v",
        assigned=assigned,
        read=read,
        constant=constant,
        rare=_rare,
        table=table,
        loop=loop,
        cell=lambda name, array, i: [
            f"  {name}.from = getelementptr $D, ptr %{array}, i64 {i}",
            f"  {name} = load $D, ptr {name}.from, align 8",
        ],
        taken=taken,
        number=_number,
        changed=changed,
    )
    flat = chain(*program.stepped.values())
    lines, names = Writer(program.graph, language).lines([*flat], program.before)
    stores = [kept(i, value) for i, value in enumerate(names) if value]
    run = Template(template("run.ll")).safe_substitute(
        constants="\n".join(constants.values()),
        rows=program.n_rows,
        parameters=max(program.n_parameters, 1),
        n_times=program.n_times,
        n_draws=program.n_draws,
        allocated="\n".join(allocated),
        step="\n".join(pointers + lines),
        stores="\n".join(stores),
    )
    return _filled(run, width)


def _filled(text: str, width: int) -> str:
    words = {
        "$D": f"<{width} x double>",
        "$B": f"<{width} x i1>",
        "$I": f"<{width} x i64>",
        "$N": f"v{width}f64",
        "$FLAGS": f"i{width}",
        "$TRUE": f"<{', '.join(['i1 true'] * width)}>",
        "$ZERO": f"<{width} x i32> zeroinitializer",
        "$SHIFT": f"<{', '.join(['i64 52'] * width)}>",
        "$FAR": f"<{', '.join([f'double {FAR}'] * width)}>",
    }
    for word, meant in words.items():
        text = text.replace(word, meant)
    for vector, number in _OF_ONE if width == 1 else ():
        text = re.sub(vector, number, text)
    return text
