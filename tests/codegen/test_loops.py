"""Loops and rare blocks of traced code: the bits of unrolled ones, in all languages."""

import ctypes
import subprocess

import numpy as np
import pytest
from numpy_lanes import NumpyLanes

from approxjac import law
from approxjac.codegen.backends.c99 import LANGUAGE
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.backends.templates import template
from approxjac.codegen.trace.program import Program, Schedule, Writer
from approxjac.codegen.trace.symbols import Scalar, symbols

N = 4
TABLE = np.array([[0.3, -1.5, 2.0], [1.1, 0.0, -0.7], [0.25, 4.0, 1.0], [-2.0, 0.125, 3.0]])


def polynomial(x, y):
    """A number and an array go on, and a table of constants is read."""

    def body(i, values):
        a, b = values
        row = law.take(TABLE, i)
        return a * row[0] + b[1], b * row[1] + x[:3] * row[2] - i

    a, b = law.repeat(N, body, (x[0], y[:3]))
    return [a, *b]


def rows(x, y):
    """Rows of symbols are read, an entry of what goes on too, and results are collected."""
    A = np.outer(x, y) + np.outer(y, np.ones(N))

    def body(i, values):
        (b,) = values
        step = law.take(A, i) @ b + law.take(b, i)
        return (b - 0.1 * step * law.take(A, i),), (step, b * step)

    (b,), (steps, parts) = law.collect(N, body, (x,))
    (again,) = law.repeat(N, lambda i, v: (v[0] + law.take(parts, i) @ x,), (steps[1],))
    return [*b, *steps, *parts.ravel(), again]


def nested(x, y):
    """A loop in a loop, and rare blocks inside of loops and around them."""

    def inner(total, j, values):
        a, b = values
        kept = law.choose(b > 0.0, lambda: (a * np.sqrt(abs(b)),), lambda: (a - b,))[0]
        return kept, b - law.take(y, j) + total * 0.5

    def outer(i, values):
        total, b = values
        a, b = law.repeat(N, lambda j, v: inner(total, j, v), (law.take(x, i), b))
        return total + a * law.take(y, i), b * 0.5

    def rare():
        total, b = law.repeat(3, outer, (x[0], y[1]))
        twice = law.choose(b < total, lambda: (np.sin(b * x[2]),), lambda: (b,))[0]
        return total, b, twice

    found = law.choose(x[1] > y[1], rare, lambda: (x[0], y[0], x[2]))
    return [*found, found[0] + 1.0]


def truths(x, y):
    """A truth value goes on, and what does not depend on the pass is computed once."""

    def body(i, values):
        a, over = values
        a = a + np.tanh(x[1]) * law.take(y, i)
        return a, over | (a > 1.0)

    a, over = law.repeat(N, body, (x[0], x[0] > 1.0))
    return [a, *law.choose(over, lambda: (a - 1.0,), lambda: (y[2],))]


def turned(x, y):
    """Numbers that change places, and one that is needed by nothing."""
    a, b, _ = law.repeat(
        3, lambda i, v: (v[1], v[0] + law.take(y, i), v[2] * v[2]), (x[0], x[1], x[2])
    )
    return [a, b]


def unrolled(count, body, start):
    values, rows = start, []
    for i in range(count):
        values, row = body(i, values)
        rows.append(row)
    return values, tuple(np.stack(column) for column in zip(*rows, strict=True))


CASES = [polynomial, rows, nested, truths, turned]


def program_of(case):
    program = Program()
    x, y = program.kept("x", N), program.kept("y", N)
    found = symbols(case(x, y))
    program.step({"found": found})
    return program


def columns(program, n=16):
    rng = np.random.default_rng(1)
    found = np.zeros((n, program.n_rows))
    found[:, : 2 * N] = rng.normal(size=(n, 2 * N))
    found[0, : 2 * N] = 0.0
    return found


def carried_out(lanes, program):
    state = columns(program)
    kept = np.array(state.reshape(-1, lanes.width, program.n_rows).swapaxes(1, 2), order="C")
    lanes.run(kept, np.zeros((len(kept), 1, lanes.width)))
    return kept.swapaxes(1, 2).reshape(state.shape)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_a_loop_has_the_bits_of_an_unrolled_one(case, monkeypatch):
    looped = program_of(case)
    assert any(node.operation == "loop" for node in looped.graph.nodes)
    for kind in (Scalar, type(symbols([]))):
        monkeypatch.setattr(kind, "looped", lambda self, *args: unrolled(*args))
    flat = program_of(case)
    assert not any(node.operation == "loop" for node in flat.graph.nodes)
    expected = carried_out(NumpyLanes(flat), flat)
    assert np.isfinite(expected).all()
    np.testing.assert_array_equal(carried_out(NumpyLanes(looped), looped), expected)
    for width in (1, 2, 8):
        np.testing.assert_array_equal(carried_out(LlvmLanes(looped, width), looped), expected)
    monkeypatch.setattr("approxjac.codegen.backends.llvm._PART", 3)  # cut in loops, too
    np.testing.assert_array_equal(carried_out(LlvmLanes(looped, 4), looped), expected)
    plain = [[float(a) for a in case(row[:N], row[N : 2 * N])] for row in columns(looped)]
    at, size = looped.rows["found"]
    np.testing.assert_allclose(expected[:, at : at + size], plain, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_c_has_the_bits_of_numpy(case, tmp_path):
    program = program_of(case)
    language = LANGUAGE._replace(read="{}[{}]".format)
    lines, names = Writer(program.graph, language).lines(program.stepped["found"])
    stores = [f"    found[{i}] = {name};" for i, name in enumerate(names)]
    head = ["#include <math.h>", "void step(const double *x, const double *y, double *found)", "{"]
    needed = "#include <stdint.h>\n#include <string.h>\n" + template("power_of_two.c")
    helper = needed if "power_of_two" in str(lines) else ""
    (tmp_path / "a.c").write_text("\n".join([helper, *head, *lines, *stores, "}"]))
    command = ["gcc", "-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror"]
    subprocess.run(
        [*command, "-shared", "-fPIC", "a.c", "-o", "a.so", "-lm"], cwd=tmp_path, check=True
    )
    function = ctypes.CDLL(str(tmp_path / "a.so")).step
    expected, (at, size) = carried_out(NumpyLanes(program), program), program.rows["found"]
    for row, known in zip(columns(program), expected[:, at : at + size], strict=True):
        found = np.zeros(size)
        x, y = row[:N].copy(), row[N : 2 * N].copy()
        function(*(ctypes.c_void_p(each.ctypes.data) for each in (x, y, found)))
        np.testing.assert_array_equal(found, known)


def test_only_the_number_of_a_pass_is_an_index():
    program = Program()
    x = program.kept("x", N)
    with pytest.raises(TypeError, match="number of a loop's pass"):
        law.take(x, x[0])
    with pytest.raises(ValueError, match="must return as many"):
        law.repeat(3, lambda i, v: (v[0], v[0]), (x[0],))
    outer = []
    law.repeat(3, lambda i, v: (outer.append(i) or v[0] + i,), (x[0],))
    with pytest.raises(TypeError, match="number of a loop's pass"):
        law.take(x, outer[0])


def test_what_is_needed_of_a_loop_alone_is_computed():
    program = Program()
    x = program.kept("x", N)
    a, b = law.repeat(3, lambda i, v: (v[0] * 2.0, np.sin(v[1])), (x[0], x[1]))
    assert len(program.graph.needed([a])) < 10 < len(program.graph.needed([b]))


def test_what_does_not_change_in_a_loop_stays_outside():
    """But within what is rare: outside of that it would not be."""
    program, seen = Program(), {}
    x, y = program.kept("x", N), program.kept("y", N)

    def looped(name, a):
        def body(i, values):
            seen[name] = np.exp(a)  # the same in each pass
            return (values[0] * seen[name] + law.take(y, i),)

        return law.repeat(3, body, (x[0],))

    (total,) = looped("always", x[1])
    (found,) = law.choose(total > 0.0, lambda: looped("rare", x[2]), lambda: (total,))
    schedule = Schedule(program.graph, [found.place])
    (rarely,) = (scope for (kind, _), scope in schedule.inside.items() if kind == "rare")
    assert seen["always"].place in schedule.whole.places
    assert seen["rare"].place in rarely.places


@pytest.mark.parametrize("column", range(3))
@pytest.mark.parametrize("kept", [1, 2])
def test_a_collected_column_is_found_among_others(column, kept):
    """Without the others, which nobody needs."""
    program = Program()
    x = program.kept("x", N)

    def body(i, values):
        a = values[0] * 0.5 + law.take(TABLE, i)[0]
        return (a, *(each - 1.0 for each in values[1:])), (a * 2.0, np.sin(a) * x[1], a - x[2])

    program.step({"found": law.collect(N, body, tuple(x[:kept]))[1][column]})
    found, (at, size) = carried_out(NumpyLanes(program), program), program.rows["found"]
    (one, two, three), expected = columns(program)[:, :3].T, []
    for i in range(N):
        one = 0.5 * one + TABLE[i, 0]
        expected.append((2.0 * one, np.sin(one) * two, one - three)[column])
    found = found[:, at : at + size]
    np.testing.assert_allclose(found, np.transpose(expected), rtol=1e-14, atol=1e-15)
