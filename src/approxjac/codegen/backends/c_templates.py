"""The texts of `export_c`'s files; $names are filled in."""

from __future__ import annotations

HEADER = """\
/* controller.h: torque control of an arm whose kinematics are not exactly known.
 *
$made_from
 *
 * Call ${prefix}_init once, and ${prefix}_step once a period, with the same state. Any number of
 * states may be in use, in any threads: there is no other memory, no allocation and no input or
 * output. Arrays are of the sizes below; no pointer may be null.
 */
#ifndef ${PREFIX}_CONTROLLER_H
#define ${PREFIX}_CONTROLLER_H

#ifdef __cplusplus
extern "C" {
#endif

enum {
    ${PREFIX}_N_Q = $nq, /* numbers of a configuration */
    ${PREFIX}_N_V = $nv, /* joints */
    ${PREFIX}_N_X = $n_x, /* numbers of a task value */
    ${PREFIX}_M = $m, /* numbers of a task error */
    ${PREFIX}_M_X = $m_x, /* and of the rate of a task value */
    ${PREFIX}_N_STATE = $n_state /* numbers of the state */
};

/* What happened in a step. Below zero: it was refused, see the torque of each. */
typedef enum {
    /* the compiler's options reorder sums or drop comparisons with NaN, as parts of -ffast-math do:
       the torque is zero, the state stays */
    ${PREFIX}_REFUSED_BUILD = -8,
    /* a first t is not finite, or a first t_x is INFINITY or more than 1 s after t, as by another
       clock: the torque is zero, the state stays; stop the robot */
    ${PREFIX}_REFUSED_T = -7,
    /* dt is not positive or not finite: the torque is that of the law, the state stays */
    ${PREFIX}_REFUSED_DT = -6,
    /* a number of the target is not finite: x counts as lost, the joints come to rest, nothing is
       learnt */
    ${PREFIX}_REFUSED_TARGET = -5,
    /* the torque or the next state overflows: the torque is zero, the state stays */
    ${PREFIX}_REFUSED_OVERFLOW = -4,
    /* a number of the state is not finite: the torque is zero; call init again */
    ${PREFIX}_REFUSED_STATE = -3,
    /* a first joint velocity is not finite: the torque is zero, the state stays; stop the robot */
    ${PREFIX}_REFUSED_V = -2,
    /* a first q is not finite, an angle is beyond 1e6 rad, or (cos, sin) are off the unit circle:
       the torque is zero, the state stays; stop the robot */
    ${PREFIX}_REFUSED_Q = -1,
$statuses
} ${prefix}_status;

/* What limits did to the torque of the law. Whatever is said below of joints that go on learning,
   with limits of torques alone nothing is learnt where the proof is given up, and nothing where
   the torque is limited without it. */
typedef enum {
$limit_statuses
} ${prefix}_limit_status;

$state_words
typedef struct {
    double values[$stored];
} ${prefix}_state;

/* What is measured. */
typedef struct {
$t_comment
    double t;
$q_comment
    double q[$nq];
$v_comment
    double v[$nv];
$x_comment
    double x[$n_x];
$t_x_comment
    double t_x;
} ${prefix}_measurement;

/* What is wanted. Zeros in v and a are a target at rest. */
typedef struct {
$target_comment
    double x[$n_x];
$target_v_comment
    double v[$m_x], a[$m_x];
} ${prefix}_target;

/* The answer to one measurement. */
typedef struct {
    double torque[$nv];   /* $commands; always finite */
    double e[$m];        /* task error [$e_units]; not finite where x is lost */
    double gravity[$nv];  /* gravity torque within the law's torque [$tau_units] */
    double J_hat[$m][$nv]; /* believed task Jacobian [$e_units, per unit of a joint] */
    double slack;       /* what limits add to V' [W]; 0 where it is not known */
    ${prefix}_status status;
    ${prefix}_limit_status limit_status;
} ${prefix}_answer;

/* Set the state before the first step from the first measurement.
 *
 * Returns 1; or 0 where the state needs a number of it that is not finite, and is not usable, or
 * where every step is refused as REFUSED_BUILD.
 */
int ${prefix}_init(${prefix}_state *state, const ${prefix}_measurement *now);

/* Take one step: fill the answer, move the state on, and return the answer's status.
 *
 * dt: time for which the torque is held [s].
 */
${prefix}_status ${prefix}_step(${prefix}_state *state, const ${prefix}_measurement *now,
    const ${prefix}_target *target, double dt, ${prefix}_answer *answer);

#ifdef __cplusplus
}
#endif

#endif
"""

SOURCE = """\
/* controller.c: see controller.h.
 *
$made_from
 *
 * Written by a program: change the controller that it was made from instead.
 */
#include "controller.h"

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined(__FAST_MATH__) || defined(__ASSOCIATIVE_MATH__) || defined(_M_FP_FAST) \\
    || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__ > 0)
#error "compile this without -ffast-math, -Ofast, -ffinite-math-only and -fassociative-math"
#elif defined(FLT_EVAL_METHOD) && FLT_EVAL_METHOD == 2
#error "compile this with -msse2 -mfpmath=sse: the x87 does not round to double"
#endif

/* With no fused multiply-adds the bits are the same everywhere. gcc does not know this pragma, but
   -ffp-contract=off (see CMakeLists.txt), which is its usual with -std=c99. */
#if !defined(__GNUC__) || defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#endif

/* Does not compile where a double, or a constant, has other than 64 bits. */
typedef char has_64_bits[sizeof(double) == 8 && sizeof(1.0) == 8 ? 1 : -1];

#define N_STATE ${PREFIX}_N_STATE
$helpers
$is_finite
/* Whether comparisons know NaN, and sums are made as written: options such as -fno-honor-nans have
   no macro to test. Adding 1.5 * 2^52 rounds to an integer. */
static int is_as_written(void)
{
    static const volatile double values[] = {NAN, 0.25};
    const double nan = values[0], rounded = (values[1] + 6755399441055744.0) - 6755399441055744.0;
    return nan != nan && !(fabs(nan) < INFINITY) && rounded == 0.0;
}

static int is_configuration(const double *q)
{
    return is_finite(q, ${PREFIX}_N_Q) && $q_checks;
}

static ${prefix}_status refused(${prefix}_answer *answer, ${prefix}_status status)
{
    memset(answer, 0, sizeof *answer);
    answer->status = status;
    return status;
}

/* The law and its limits. What is in a block of `if` is needed only there. */
static void evaluate(const ${prefix}_measurement *now, const ${prefix}_target *target,
    const double *state, double dt, ${prefix}_answer *answer, double *after)
{
$lines
    (void)now, (void)target, (void)state, (void)dt;
$stores
}

int ${prefix}_init(${prefix}_state *state, const ${prefix}_measurement *now)
{
$first
    return is_as_written() && is_finite(state->values, N_STATE);
}

${prefix}_status ${prefix}_step(${prefix}_state *state, const ${prefix}_measurement *now,
    const ${prefix}_target *target, double dt, ${prefix}_answer *answer)
{
    static const ${prefix}_target nowhere = {{$nowhere}, {0.0}, {0.0}};
    ${prefix}_measurement blind;
    double after[$stored];
    const double *kept = state->values;
    int i, is_target, is_dt, is_bridged;
    if (!is_as_written()) {
        return refused(answer, ${PREFIX}_REFUSED_BUILD);
    }
    if (!is_finite(state->values, N_STATE)) {
        return refused(answer, ${PREFIX}_REFUSED_STATE);
    }
    is_dt = is_finite(&dt, 1) && dt > 0.0;
    is_bridged = is_dt && $is_bridged; /* bad samples are, once there was a good one */
    if (!is_configuration(now->q)) {
        if (!is_bridged) {
            return refused(answer, ${PREFIX}_REFUSED_Q);
        }
        blind = *now;
        blind.q[0] = NAN;
        now = &blind;
    }
    if (!is_bridged && !is_finite(now->v, ${PREFIX}_N_V)) {
        return refused(answer, ${PREFIX}_REFUSED_V);
    }
$t_checks    is_target = is_finite(target->x, ${PREFIX}_N_X)$rate_checks;
    if (!is_target) {
        blind = *now;
        for (i = 0; i < ${PREFIX}_N_X; ++i) {
            blind.x[i] = NAN;
        }
        now = &blind;
    }
$unguarded    evaluate(now, is_target ? target : &nowhere, kept, is_dt ? dt : 0.0, answer, after);
    if (!is_finite(answer->torque, ${PREFIX}_N_V) || !is_finite(after, N_STATE)$is_unseen) {
        return refused(answer, ${PREFIX}_REFUSED_OVERFLOW);
    }
    if (!is_target) {
        answer->status = ${PREFIX}_REFUSED_TARGET;
    }
    if (!is_dt) {
        answer->status = ${PREFIX}_REFUSED_DT;
    } else {
        for (i = 0; i < N_STATE; ++i) {
            state->values[i] = after[i];
        }
    }
    return answer->status;
}
"""

POWER_OF_TWO = """
static double power_of_two(double shifted)
{
    uint64_t bits;
    memcpy(&bits, &shifted, sizeof bits);
    bits <<= 52;
    memcpy(&shifted, &bits, sizeof bits);
    return shifted;
}
"""

IS_FINITE = """\
/* Looks at bits, as some options let compilers drop comparisons with NaN. */
static int is_finite(const double *values, int size)
{
    const uint64_t exponent = (uint64_t)0x7ff << 52;
    uint64_t bits;
    int i;
    for (i = 0; i < size; ++i) {
        memcpy(&bits, &values[i], sizeof bits);
        if ((bits & exponent) == exponent) {
            return 0;
        }
    }
    return 1;
}
"""

SELFTEST = """\
/* selftest.c: recorded steps, to the bit, and what is refused.
 *
 * The bits are those of a compiler that contracts and reorders nothing: see CMakeLists.txt.
 */
#include "controller.h"

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

typedef struct {
    ${prefix}_measurement now;
    ${prefix}_target target;
    double torque[$nv], after[$stored], slack;
    int status, limit_status, begins;
} record;

static const record records[] = {
$records
};

$is_finite
/* A step's arguments, of which each is a number. */
typedef struct {
    ${prefix}_measurement now;
    ${prefix}_target target;
    ${prefix}_state state;
    double dt;
} arguments;

/* Returns how many numbers of a step's arguments, from `first` on, are not refused with a status
   where they are not finite, or whatever the status (0) give a torque or a state that is none. */
static int taken(const arguments *usual, const double *first, int size, int status)
{
    static const double wrong[] = {NAN, INFINITY, -INFINITY};
    const size_t start = (size_t)((const char *)first - (const char *)usual);
    ${prefix}_answer answer;
    int i, k, found = 0;
    for (i = 0; i < 3 * size; ++i) {
        arguments given = *usual;
        memcpy((char *)&given + start + sizeof(double) * (size_t)(i / 3), &wrong[i % 3],
            sizeof(double));
        k = ${prefix}_step(&given.state, &given.now, &given.target, given.dt, &answer);
        found += (status && k != status && k != ${PREFIX}_REFUSED_OVERFLOW)
            || !is_finite(answer.torque, ${PREFIX}_N_V)
            || (k != ${PREFIX}_REFUSED_STATE
                && !is_finite(given.state.values, ${PREFIX}_N_STATE));
    }
    return found;
}

int main(void)
{
    ${prefix}_state state;
    ${prefix}_answer answer;
    arguments usual;
    int failed = 0, i, k, wrong;
    const int count = (int)(sizeof records / sizeof records[0]);
    double largest = 0.0;
    for (k = 0; k < count; ++k) {
        const record *r = &records[k];
        int status, is_same;
        if (r->begins && !${prefix}_init(&state, &r->now)) {
            printf("init failed; a cause may be the compiler's options: see REFUSED_BUILD\\n");
            return 1;
        }
        status = ${prefix}_step(&state, &r->now, &r->target, $dt, &answer);
        is_same = status == r->status && (int)answer.limit_status == r->limit_status
            && memcmp(answer.torque, r->torque, sizeof r->torque) == 0
            && memcmp(state.values, r->after, ${PREFIX}_N_STATE * sizeof(double)) == 0
            && memcmp(&answer.slack, &r->slack, sizeof r->slack) == 0;
        failed += !is_same;
        for (i = 0; i < ${PREFIX}_N_V; ++i) {
            largest = fmax(largest, fabs(answer.torque[i] - r->torque[i]));
        }
    }
    printf("%d of %d steps to the bit; largest difference of a torque %g\\n", count - failed, count,
        largest);
    usual.now = records[0].now;
    usual.target = records[0].target;
    usual.dt = $dt;
    ${prefix}_init(&usual.state, &usual.now);
    wrong = taken(&usual, usual.now.q, ${PREFIX}_N_Q, ${PREFIX}_REFUSED_Q)
        + taken(&usual, usual.now.v, ${PREFIX}_N_V, ${PREFIX}_REFUSED_V)
        + taken(&usual, usual.state.values, ${PREFIX}_N_STATE, ${PREFIX}_REFUSED_STATE)
        + taken(&usual, usual.target.x, ${PREFIX}_N_X, ${PREFIX}_REFUSED_TARGET)
        + taken(&usual, &usual.dt, 1, ${PREFIX}_REFUSED_DT)
        + taken(&usual, &usual.now.t, 1, 0) + taken(&usual, &usual.now.t_x, 1, 0)
        + taken(&usual, usual.now.x, ${PREFIX}_N_X, 0)
        + taken(&usual, usual.target.v, 2 * ${PREFIX}_M_X, 0);
    if (wrong) {
        printf("%d numbers that are not finite were not refused\\n", wrong);
    }
    failed += wrong;
    return failed != 0;
}
"""

CMAKE = """\
# A controller as a library, and a self-test:
#   cmake -B build -DCMAKE_BUILD_TYPE=Release && cmake --build build && ctest --test-dir build
cmake_minimum_required(VERSION 3.10)
project(${prefix}_controller C)

if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()

add_library(${prefix}_controller STATIC controller.c)
target_include_directories(${prefix}_controller PUBLIC $${CMAKE_CURRENT_SOURCE_DIR})
set_target_properties(${prefix}_controller PROPERTIES
  C_STANDARD 99 C_STANDARD_REQUIRED ON C_EXTENSIONS OFF POSITION_INDEPENDENT_CODE ON)
if(CMAKE_C_COMPILER_ID MATCHES "GNU|Clang")
  # the same bits on every machine: no fused multiply-adds. Never -ffast-math.
  target_compile_options(${prefix}_controller PRIVATE -ffp-contract=off)
endif()
if(UNIX)
  target_link_libraries(${prefix}_controller PUBLIC m)
endif()

add_executable(${prefix}_selftest selftest.c)
set_target_properties(${prefix}_selftest PROPERTIES C_STANDARD 99 C_STANDARD_REQUIRED ON)
target_link_libraries(${prefix}_selftest PRIVATE ${prefix}_controller)

enable_testing()
add_test(NAME selftest COMMAND ${prefix}_selftest)
"""
